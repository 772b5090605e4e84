"""Bad input ends with exit code 2 and one line that names the fix; nothing is left behind."""

from pathlib import Path

import pytest
from commands import code_of, refused

from tom.cli import main
from tom.config import OnlineConfig
from tom.record import Store
from tom.record.writer import RunWriter
from tom.training.presets import resolve

TRAIN = ["train", "--env", "inverted-pendulum", "--learner", "mle", "--preset", "smoke"]
SWEEP = ["sweep", *TRAIN[1:]]
BRUSH = ["brush", "no-run", "--rows", "no-rows", "--step", "1"]


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (["train", "--env", "hoper", "--learner", "mle"], "did you mean 'hopper'?"),
        (["train", "--env", "Pendulum-v1", "--learner", "mle"], "gymnasium:Pendulum-v1"),
        (["train", "--env", "hopper", "--learner", "pmacs"], "did you mean 'pmac'?"),
        ([*TRAIN[:-1], "smok"], "did you mean 'smoke'?"),
        ([*TRAIN, "--sac.discount", "2"], "--sac.discount 2"),
        ([*SWEEP, "--seeds", "1", "9223372036854775808"], "seed 9223372036854775808"),
        ([*TRAIN, "--sac.lr", "inf"], "--sac.lr inf"),
        ([*TRAIN, "--sac.discont", "0.9"], "did you mean --sac.discount?"),
        ([*TRAIN, "--run-id", "../escape"], "../escape"),
        ([*TRAIN, "--device", "quantum"], "--device quantum"),
        (["train", "--learner", "mle"], "--env"),
        (["train", "--resume", "one", "--run-id", "mine"], "--run-id"),
        ([*TRAIN, "--seeds", "0"], "unknown argument --seeds, did you mean --seed?"),
        (["demo", "--headless", "--seed", "-1"], "--seed"),
        ([*SWEEP, "--only", "1"], "runs 0 to 0"),
        ([*SWEEP, "--engine", "pbs"], "pbs"),
        ([*SWEEP, "--seed", "3"], "unknown argument --seed, did you mean --seeds?"),
        ([*SWEEP, "--only", "0", "--engine", "slurm"], "--only is given to each task"),
        (["sweep"], "--env and --learner"),
        (["sweep", "--file", "/no/plan.yaml"], "cannot read"),
        (["reproduce", "returns"], "tom sweep"),
        (["reproduce", "online"], "tom sweep"),
        (["reproduce", "returns", "--env", "hoper"], "did you mean 'hopper'"),
        (["reproduce", "returns", "--at", "late"], "'late'"),
        (["reproduce", "returns", "--env", "hopper", "--at", "ant=9"], "--at ant=9"),
        (["reproduce"], "STUDY"),
        ([*BRUSH, "--factors", "4", "nan"], "factor nan"),
        (["trian"], "trian"),
        ([], "COMMAND"),
    ],
)
def test_bad_input(arguments, named, capsys, tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.chdir(tmp_path)
    refused(arguments, capsys, named)
    assert list(tmp_path.iterdir()) == []


def test_a_run_id_that_is_taken(capsys, tmp_path: Path):
    arguments = [*TRAIN, "--steps", "50", "--store", str(tmp_path), "--run-id", "mine"]
    assert code_of(arguments) == 0
    before = (tmp_path / "mine" / "metrics.jsonl").read_bytes()
    refused(arguments, capsys, "'mine' exists already")
    again = ["train", "--resume", "mine", "--steps", "60", "--store", str(tmp_path)]
    for other in ("--learner pmac", "--env hopper", "--preset paper"):
        refused([*again, *other.split()], capsys, f"{other}: run 'mine' was made with")
    assert (tmp_path / "mine" / "metrics.jsonl").read_bytes() == before


def test_steps_that_a_run_cannot_go_on_to(capsys, tmp_path: Path):
    config = resolve("inverted-pendulum", "mle", "smoke", {})
    RunWriter.create(Store(tmp_path), "mine", config).close()
    for steps in ("99999999999999999999", "0"):
        words = ["train", "--resume", "mine", f"--steps={steps}", "--store", str(tmp_path)]
        refused(words, capsys, f"--steps {steps}")


def test_help_shows_the_defaults_of_what_is_named(capsys: pytest.CaptureFixture[str]):
    said = {}
    for env in ("hopper", "humanoid"):
        with pytest.raises(SystemExit, match="0"):
            main(["train", "--env", env, "--preset", "paper", "--help"])
        said[env] = " ".join(capsys.readouterr().out.split())
    for env in said:
        config = resolve(env, "tom", "paper")
        assert isinstance(config, OnlineConfig)
        assert f"[{config.total_steps}]" in said[env]
        assert f"units per hidden layer [{config.model.hidden}]" in said[env]
    assert said["hopper"] != said["humanoid"]
