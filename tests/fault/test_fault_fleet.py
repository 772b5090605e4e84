"""Several trainings of one command: a member that fails, a stop, a kill, Ctrl-C."""

import signal
from pathlib import Path

import pytest
from faults import SETTINGS, ended, tom, train_command, wait_until
from same_records import assert_same_record

from tom.config import OnlineConfig
from tom.record import RunReader, Store, checkpoint
from tom.training.plan import Trial
from tom.training.run import train

pytestmark = pytest.mark.fault

STEPS = 400


def trials(**changes: object) -> list[Trial]:
    settings = {**SETTINGS, "steps": STEPS, **changes}
    which = (("mle", 0), ("mle", 1), ("tom", 0))
    return [Trial("inverted-pendulum", name, seed, "smoke", settings) for name, seed in which]


def command(store: Path, engine: str, *which: object, **changes: object) -> list[object]:
    words = train_command(store, **{"steps": STEPS, **changes})  # pyright: ignore[reportArgumentType]
    return [*words, "--engine", engine, *which]


def alone(path: Path, trial: Trial) -> RunReader:
    assert isinstance(trial.config, OnlineConfig)
    return train(trial.config, Store(path), trial.run_id, rerun=False)


def runs(store: Path) -> list[RunReader]:
    return Store(store).runs()


def all_under_way(store: Path, count: int) -> bool:
    """Whether so many runs have a checkpoint and no run is finished."""
    begun = [run for run in runs(store) if checkpoint.newest(run.path / checkpoint.FOLDER)]
    return len(begun) == count


def test_sigterm_to_a_fleet__every_member_has_a_checkpoint_and_the_same_command_goes_on(
    tmp_path: Path,
):
    both = command(tmp_path / "store", "fleet", "--seeds", 0, 1)
    process = tom(*both)
    wait_until(lambda: all_under_way(tmp_path / "store", 2))
    process.send_signal(signal.SIGTERM)
    code, _, error = ended(process)
    assert code == 1, error
    stopped = runs(tmp_path / "store")
    assert [run.status.state for run in stopped] == ["stopped", "stopped"]
    for run in stopped:
        assert checkpoint.newest(run.path / checkpoint.FOLDER) == run.status.env_step
    assert ended(tom(*both))[0] == 0
    for trial in trials()[:2]:
        mine = Store(tmp_path / "store").run(trial.run_id)
        assert_same_record(alone(tmp_path / "truth", trial), mine)


def test_a_fleet_killed_with_sigkill__the_same_command_ends_as_if_undisturbed(tmp_path: Path):
    both = command(tmp_path / "store", "fleet", "--seeds", 0, 1)
    process = tom(*both)
    wait_until(lambda: all_under_way(tmp_path / "store", 2))
    process.kill()
    ended(process)
    assert ended(tom(*both))[0] == 0
    assert len(runs(tmp_path / "store")) == 2
    for trial in trials()[:2]:
        mine = Store(tmp_path / "store").run(trial.run_id)
        assert_same_record(alone(tmp_path / "truth", trial), mine)


def test_a_member_of_a_fleet_that_diverges__exit_1_with_its_name_and_the_others_finish(
    tmp_path: Path,
):
    # Only TOM has a discriminator: at this rate its loss is not a number after a step.
    bad = {"tom": {"warmup": 30, "discriminator_lr": 1e30}}
    words = command(tmp_path, "fleet", "--learner", "mle", "tom", **bad)
    code, _, error = ended(tom(*words))
    assert code == 1
    assert len(error.strip().splitlines()) == 1
    assert "tom" in error
    assert "--tom.discriminator-lr" in error
    states = {run.learner: run.status.state for run in runs(tmp_path)}
    assert states == {"mle": "finished", "tom": "failed"}


def test_ctrl_c_of_several_processes__each_has_a_checkpoint_and_the_same_command_goes_on(
    tmp_path: Path,
):
    both = command(tmp_path / "store", "processes", "--seeds", 0, 1)
    process = tom(*both)
    wait_until(lambda: all_under_way(tmp_path / "store", 2))
    process.send_signal(signal.SIGINT)
    assert ended(process)[0] != 0
    assert {run.status.state for run in runs(tmp_path / "store")} == {"stopped"}
    assert ended(tom(*both))[0] == 0
    for trial in trials()[:2]:
        mine = Store(tmp_path / "store").run(trial.run_id)
        assert_same_record(alone(tmp_path / "truth", trial), mine)
