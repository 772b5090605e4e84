"""`tom train` with several learners and seeds."""

import pytest

from tom.cli import main

HOPPER = ["train", "--env", "hopper", "--preset", "smoke"]


@pytest.mark.parametrize(
    ("words", "hint"),
    [
        (["--learner", "mle", "toom", "--seeds", "0"], "did you mean 'tom'"),
        (["--learner", "mle", "--seeds", "0", "1", "--seed", "3"], "--seed and --seeds"),
        (["--learner", "mle", "tom", "--seed", "one"], "--seed one"),
        (["--learner", "mle", "tom", "--run-id", "mine"], "one training alone"),
        (["--learner", "mle", "tom", "--sac.lr", "-1"], "--sac.lr -1"),
        (["--learner", "mle", "--device", "quantum"], "must be cpu or cuda"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(words: list[str], hint: str, capsys, tmp_path):
    store = tmp_path / "runs"
    assert main([*HOPPER, *words, "--store", str(store)]) == 2
    error = capsys.readouterr().err
    assert hint in error
    assert len(error.splitlines()) == 1
    assert not store.exists()
