"""A sweep's driver without and with real trainings; what is slow or violent is in test_faults."""

import _thread
import json
import threading
import time
from dataclasses import asdict
from pathlib import Path
from typing import Literal

import pytest
from commands import code_of
from common import measured, recorded
from sweeping import plan, until

from tom.events import Tick
from tom.record import Store, checkpoint, layout
from tom.record.export import export_small
from tom.record.files import replace_json
from tom.record.status import DEAD_AFTER_S, Status
from tom.record.writer import RunWriter
from tom.sweep.driver import Driver, FolderBackend
from tom.sweep.engine import LocalEngine, train_all
from tom.sweep.projection import cost
from tom.training.plan import Trial, checked, trials

SMOKE = ("--env", "inverted-pendulum", "--learner", "mle", "--preset", "smoke", "--steps", "250")

PLAN = {"env": "inverted-pendulum", "learner": "mle", "preset": "smoke", "steps": 250}


def sweep(capsys, store: Path, *words: str) -> str:
    """What a sweep prints, which ends well."""
    capsys.readouterr()
    assert code_of(["sweep", *words, "--store", str(store)]) == 0
    return capsys.readouterr().out


@pytest.mark.slow
def test_a_sweep_runs_once_and_is_then_skipped(tmp_path: Path, capsys):
    out = sweep(capsys, tmp_path, *SMOKE, "--dry-run", "--json")
    planned = json.loads(out)
    assert [row["state"] for row in planned["runs"]] == ["new"]
    assert planned["hours"] == 0  # nothing to judge it by
    assert list(tmp_path.iterdir()) == []

    out = sweep(capsys, tmp_path, *SMOKE, "--json")
    (row,) = json.loads(out)
    assert (row["state"], row["env_step"]) == ("finished", 250)
    assert Store(tmp_path).run(row["run_id"]).status.state == "finished"
    before = (tmp_path / row["run_id"] / "metrics.jsonl").stat().st_mtime_ns

    out = sweep(capsys, tmp_path, *SMOKE)
    assert "was there already" in out
    assert (tmp_path / row["run_id"] / "metrics.jsonl").stat().st_mtime_ns == before

    out = sweep(capsys, tmp_path, *SMOKE, "--seeds", "0", "1", "--dry-run", "--json")
    assert [r["state"] for r in json.loads(out)["runs"]] == ["finished", "new"]
    assert "1 to do" in sweep(capsys, tmp_path, *SMOKE, "--seeds", "0", "1", "--dry-run")


def test_a_file_and_options_on_top_of_it(tmp_path: Path, capsys):
    plan = tmp_path / "plan.yaml"
    plan.write_text(
        "env: hopper\nlearner: [tom, mle]\nseeds: [0, 1]\nsettings: {sac: {tau: 0.1}}\n"
    )
    words = ("--file", str(plan), "--learner", "tom", "--sac.lr", "1e-4", "--dry-run", "--json")
    out = sweep(capsys, tmp_path / "store", *words)
    assert [(r["learner"], r["seed"]) for r in json.loads(out)["runs"]] == [("tom", 0), ("tom", 1)]


def test_a_small_copy_of_a_finished_run_is_done_and_called_one(tmp_path: Path, capsys):
    (trial,) = trials(checked(PLAN))
    store, copies = Store(tmp_path), tmp_path / "copies"
    steps = [(step, {"time/wall_s": float(step)}) for step in (200, 250)]
    measured(store, trial.run_id, "mle", 0, *steps, env=PLAN["env"], preset="smoke", steps=250)
    export_small(store.run(trial.run_id), copies)
    words = (*SMOKE, "--dry-run")
    assert "finished (a small copy)" in sweep(capsys, copies, *words)
    out = sweep(capsys, copies, *SMOKE)
    assert "finished (was there already)" in out
    other = trials(checked({**PLAN, "seeds": [1]}))[0]
    assert cost(other, store.runs()) is not None
    assert cost(other, Store(copies).runs()) is None  # its size says nothing of a run's


def test_a_run_that_was_given_more_steps_and_has_those_of_the_plan_is_done(tmp_path: Path, capsys):
    (trial,) = trials(checked(PLAN))
    more = trial.config.but(steps=2 * trial.config.steps)
    ticked = [Tick(trial.config.total_steps + 10, "optimise")]
    recorded(Store(tmp_path), trial.run_id, more, ticked, state="stopped")
    out = sweep(capsys, tmp_path, *SMOKE, "--dry-run")
    assert "0 to do" in out
    out = sweep(capsys, tmp_path, *SMOKE)
    assert "was there already" in out
    assert len(Store(tmp_path).runs()) == 1


@pytest.mark.slow
def test_a_run_that_was_given_fewer_steps_gets_the_rest(tmp_path: Path, capsys):
    words = ("--run-id", trials(checked(PLAN))[0].run_id, "--no-rerun", "--store", str(tmp_path))
    assert code_of(["train", *SMOKE[:-1], "210", *words]) == 0
    out = sweep(capsys, tmp_path, *SMOKE, "--json")
    (row,) = json.loads(out)
    assert (row["state"], row["env_step"]) == ("finished", 250)
    (run,) = Store(tmp_path).runs()
    assert run.config["config"]["steps"] == 250


def test_a_longer_run_is_not_thrown_away_for_one_that_never_got_anywhere(tmp_path: Path):
    (trial,) = trials(checked(PLAN))
    store, more = Store(tmp_path), trial.config.but(steps=2 * trial.config.steps)
    recorded(store, trial.run_id, more, [Tick(more.steps, "optimise")])
    RunWriter.create(store, "by-hand", trial.config).close()
    driver = Driver(FolderBackend(store), [trial], LocalEngine(1))
    assert driver.poll()
    assert (driver.jobs[0].state, driver.jobs[0].run_id) == ("finished", trial.run_id)
    assert sorted(run.run_id for run in store.runs()) == ["by-hand", trial.run_id]


def finished(store: Store, trial: Trial) -> Path:
    """A run of the trial that is finished, with its last checkpoint."""
    ticked = [Tick(trial.config.total_steps, "optimise")]
    path = recorded(store, trial.run_id, trial.config, ticked).path
    checkpoint.save(path / checkpoint.FOLDER, trial.config.total_steps, {})
    return path


def test_nothing_is_started_on_a_full_disk(tmp_path: Path):
    planned = trials(checked({"env": "inverted-pendulum", "learner": "mle", "preset": "smoke"}))
    driver = Driver(FolderBackend(Store(tmp_path)), planned, LocalEngine(1), low_bytes=1e18)
    assert not driver.poll()
    assert driver.full
    assert [job.state for job in driver.jobs] == ["waiting"]
    assert list(tmp_path.iterdir()) == []


class Patchy(FolderBackend):
    """Folders of which some cannot be reached."""

    away: str | None = None

    def update(self, run_id: str, *, now: bool = False) -> None:
        if run_id == self.away:
            raise OSError("this one is out of reach")


@pytest.mark.parametrize("state", ["elsewhere", "waiting"])
def test_a_run_out_of_reach_holds_up_no_other(
    state: Literal["elsewhere", "waiting"], tmp_path: Path
):
    planned, backend = trials(checked({**PLAN, "seeds": [0, 1, 2]})), Patchy(Store(tmp_path))
    driver = Driver(backend, planned, LocalEngine(3))
    for job in driver.jobs:
        finished(driver.store, job.trial)
        job.state = state
    lost = driver.jobs[1]
    backend.away = lost.run_id
    assert not driver.poll()
    assert not driver.poll()
    assert driver.trouble == "this one is out of reach"
    assert [job.run_id for job in driver.jobs if job.state != "finished"] == [lost.run_id]
    backend.away = None
    assert driver.poll()
    assert (lost.state, driver.trouble) == ("finished", "")


# Two sweeps of one store, on one machine or on two, which come upon the same run

LONG_S = 1e6  # what waits that long is not started within a test


@pytest.fixture
def trial() -> Trial:
    (one,) = plan(learner=["mle"], seeds=[0])
    return one


@pytest.fixture
def died_early(tmp_path: Path, trial: Trial) -> Store:
    """A store with a run that has no checkpoint, and so is to begin anew."""
    store = Store(tmp_path)
    RunWriter.create(store, trial.run_id, trial.config).close()
    return store


def beats(run: Path, now: float) -> None:
    """The status that another machine's writer puts there."""
    replace_json(run / layout.STATUS, asdict(Status("running", heartbeat=now)), sync=False)


@pytest.mark.parametrize("off_s", [-1e4, 1e4])
def test_a_run_of_another_machine_is_watched_whatever_its_clock_says(
    off_s: float, died_early: Store, trial: Trial
):
    run, now = died_early.run(trial.run_id), 0.0
    (run.path / layout.LOCK).write_text("another machine")
    backend = FolderBackend(died_early, lambda: now)
    for beat in range(3):
        beats(run.path, time.time() + off_s + beat)
        assert backend.writer(died_early.run(trial.run_id))
        now += DEAD_AFTER_S - 1.0
        assert backend.writer(died_early.run(trial.run_id))
    now += 1.0
    assert not backend.writer(died_early.run(trial.run_id))


@pytest.mark.slow
def test_a_run_that_another_machine_trains_takes_no_core_of_this_one(tmp_path: Path):
    store, planned = Store(tmp_path), plan(learner=["mle"], seeds=[0, 1])
    writer = RunWriter.create(store, planned[0].run_id, planned[0].config)
    writer.close()
    (writer.path / layout.LOCK).write_text("another machine")
    beats(writer.path, time.time())
    driver = Driver(FolderBackend(store), planned, LocalEngine(1), back_off_s=LONG_S)
    try:
        assert not driver.poll()
        assert [job.state for job in driver.jobs] == ["elsewhere", "running"]
        assert not driver.poll()
        assert driver.jobs[1].state == "running"
    finally:
        driver.stop()


# Many trainings without a driver

QUICK = ("--env", "inverted-pendulum", "--preset", "smoke", "--no-rerun")


def words(name: str, store: Path, *more: str) -> tuple[str, ...]:
    return (*QUICK, "--store", str(store), "--run-id", name, *more)


@pytest.mark.slow
def test_every_training_is_run_and_its_exit_code_reported(tmp_path: Path):
    good = words("good", tmp_path, "--learner", "mle", "--steps", "60")
    bad = words("bad", tmp_path, "--learner", "mlee")
    assert train_all({"good": good, "bad": bad}, workers=2) == {"good": 0, "bad": 2}
    assert [run.run_id for run in Store(tmp_path).runs()] == ["good"]


@pytest.mark.fault
def test_interrupt_while_several_train__stops_all_with_a_checkpoint(tmp_path: Path):
    """The caller's Ctrl-C: the running training ends as `stopped`, with a checkpoint."""
    store = Store(tmp_path)

    def interrupt() -> None:
        until(lambda: any(run.status.env_step for run in store.runs()))
        _thread.interrupt_main()

    threading.Thread(target=interrupt).start()
    with pytest.raises(KeyboardInterrupt):
        train_all({"long": words("long", tmp_path, "--learner", "mle", "--steps", "100000")})
    status = store.run("long").status
    assert status.state == "stopped"
    assert "--resume long" in status.reason
