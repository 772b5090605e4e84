"""`tom train` with several learners and seeds."""

import json
from pathlib import Path

import pytest

from tom.cli import main
from tom.cli.train_many import run_fleets
from tom.training.plan import Trial
from tom.training.run import Stop

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
        (["--learner", "mle", "--device", "cuda", "--engine", "processes"], "on a GPU"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(words: list[str], hint: str, capsys, tmp_path):
    store = tmp_path / "runs"
    assert main([*HOPPER, *words, "--store", str(store)]) == 2
    error = capsys.readouterr().err
    assert hint in error
    assert len(error.splitlines()) == 1
    assert not store.exists()


def test_fleets_that_never_began_are_not_finished(capsys, tmp_path: Path):
    fleets = [[Trial(env, "mle", 0, "smoke", {})] for env in ("hopper", "inverted-pendulum")]
    stop = Stop()
    stop()
    assert run_fleets(tmp_path, fleets, stop, rerun=False, as_json=True) == 1
    assert json.loads(capsys.readouterr().out) == []
    assert list(tmp_path.iterdir()) == []
