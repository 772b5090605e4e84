"""Bad input ends with exit code 2 and one line that names the fix; nothing is left behind."""

from pathlib import Path

import pytest
from commands import code_of

from tom.record import Store
from tom.record.writer import RunWriter
from tom.training.presets import resolve

TRAIN = ["train", "--env", "inverted-pendulum", "--learner", "mle", "--preset", "smoke"]
BRUSH = ["brush", "no-run", "--rows", "no-rows", "--step", "1"]


def outcome(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> tuple[int, str]:
    return code_of(arguments), capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["train", "--env", "hoper", "--learner", "mle"], "did you mean 'hopper'?"),
        (["train", "--env", "hoper", "--learner", "mle"], "gymnasium:"),
        (["train", "--env", "Pendulum-v1", "--learner", "mle"], "gymnasium:Pendulum-v1"),
        (["train", "--env", "hopper", "--learner", "pmacs"], "did you mean 'pmac'?"),
        ([*TRAIN[:-1], "smok"], "did you mean 'smoke'?"),
        ([*TRAIN, "--sac.discount", "2"], "--sac.discount 2"),
        ([*TRAIN, "--seeds", "1", "9223372036854775808"], "seed 9223372036854775808"),
        ([*TRAIN, "--sac.lr", "inf"], "--sac.lr inf"),
        ([*TRAIN, "--sac.tau", "fast"], "--sac.tau fast"),
        ([*TRAIN, "--sac.discont", "0.9"], "did you mean --sac.discount?"),
        ([*TRAIN, "--run-id", "../escape"], "../escape"),
        ([*TRAIN, "--tom.divergence", "chi3"], "--tom.divergence chi3"),
        ([*TRAIN, "--device", "quantum"], "--device quantum"),
        (["train", "--learner", "mle"], "--env"),
        (["train", "--resume", "one", "--seeds", "1"], "--seeds"),
        ([*TRAIN, "--learner", "mle", "toom", "--seeds", "0"], "did you mean 'tom'"),
        ([*TRAIN, "--seeds", "0", "1", "--seed", "3"], "--seed and --seeds"),
        ([*TRAIN, "--learner", "mle", "tom", "--run-id", "mine"], "--run-id"),
        ([*TRAIN, "--learner", "mle", "tom", "--sac.lr", "-1"], "sac.lr -1"),
        (["demo", "--headless", "--seed", "-1"], "--seed"),
        (["reproduce", "progression", "--sac-seeds", "-1"], "--sac-seeds"),
        (["reproduce", "returns", "--at", "0"], "--at"),
        (["reproduce"], "STUDY"),
        (["reproduce", "progresion"], "progresion"),
        (["reproduce", "progression", "--env", "hoper"], "did you mean 'hopper'?"),
        ([*BRUSH, "--factors", "4", "nan"], "factor nan"),
        (["trian"], "trian"),
        ([], "COMMAND"),
    ],
)
def test_bad_input(arguments, named, capsys, tmp_path: Path):
    store = tmp_path / "store"
    extra = ["--store", str(store)] if arguments[:1] == ["train"] else []
    code, message = outcome([*arguments, *extra], capsys)
    assert code == 2
    assert named in message
    assert message.count("\n") == 1
    assert not store.exists()


def test_a_store_that_is_a_file(capsys, tmp_path: Path):
    store = tmp_path / "store"
    store.write_text("not a folder")
    code, message = outcome([*TRAIN, "--store", str(store)], capsys)
    assert code == 2
    assert "--store" in message
    assert message.count("\n") == 1
    assert store.read_text() == "not a folder"


def test_a_run_id_that_is_taken(capsys, tmp_path: Path):
    arguments = [*TRAIN, "--steps", "50", "--store", str(tmp_path), "--run-id", "mine"]
    assert outcome(arguments, capsys)[0] == 0
    before = (tmp_path / "mine" / "metrics.jsonl").read_bytes()
    code, message = outcome(arguments, capsys)
    assert code == 2
    assert "'mine' exists already" in message
    assert (tmp_path / "mine" / "metrics.jsonl").read_bytes() == before


@pytest.mark.parametrize("steps", ["99999999999999999999", "many", "0"])
def test_steps_that_a_run_cannot_go_on_to(steps: str, capsys, tmp_path: Path):
    config = resolve("inverted-pendulum", "mle", "smoke", {})
    RunWriter.create(Store(tmp_path), "mine", config).close()
    words = ["train", "--resume", "mine", f"--steps={steps}", "--store", str(tmp_path)]
    code, message = outcome(words, capsys)
    assert code == 2
    assert f"--steps {steps}" in message
    assert message.count("\n") == 1
