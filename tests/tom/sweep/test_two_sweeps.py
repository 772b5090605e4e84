"""Two sweeps of one store, on one machine or on two, which come upon the same run."""

import time
from dataclasses import asdict, replace
from pathlib import Path

import pytest
from sweeping import plan

from tom.record import Store, layout
from tom.record.files import replace_json
from tom.record.status import DEAD_AFTER_S, Status
from tom.record.writer import RunWriter
from tom.sweep.backend import FolderBackend
from tom.sweep.driver import Driver
from tom.sweep.engine import LocalEngine
from tom.training.plan import Trial

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


@pytest.mark.parametrize("off_s", [-1e4, 1e4])
def test_a_run_of_another_machine_is_watched_whatever_its_clock_says(
    off_s: float, died_early: Store, trial: Trial
):
    run, now = died_early.run(trial.run_id), 0.0
    (run.path / layout.LOCK).write_text("another machine")
    backend = FolderBackend(died_early, lambda: now)
    for beat in range(3):
        beats = Status("running", heartbeat=time.time() + off_s + beat)
        replace_json(run.path / layout.STATUS, asdict(beats), sync=False)
        assert backend.writer(died_early.run(trial.run_id))
        now += DEAD_AFTER_S - 1.0
        assert backend.writer(died_early.run(trial.run_id))
    now += 1.0
    assert not backend.writer(died_early.run(trial.run_id))


@pytest.mark.parametrize("away", [True, False])
def test_a_run_that_another_machine_trains_takes_no_core_of_this_one(away: bool, tmp_path: Path):
    store, planned = Store(tmp_path), plan(learner=["mle"], seeds=[0, 1])
    writer = RunWriter.create(store, planned[0].run_id, planned[0].config)
    if away:
        writer.close()
        (writer.path / layout.LOCK).write_text("another machine")
        beats = replace(store.run(writer.run_id).status, state="running", heartbeat=time.time())
        replace_json(writer.path / layout.STATUS, asdict(beats), sync=False)
    driver = Driver(FolderBackend(store), planned, LocalEngine(1), back_off_s=LONG_S)
    try:
        assert not driver.poll()
        second = "running" if away else "waiting"
        assert [job.state for job in driver.jobs] == ["elsewhere", second]
        assert not driver.poll()
        assert driver.jobs[1].state == second
    finally:
        driver.stop()
        writer.close()
