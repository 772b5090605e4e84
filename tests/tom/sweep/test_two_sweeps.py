"""Two sweeps of one store, on one machine or on two, which come upon the same run."""

import time
from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path

import pytest
from sweeping import plan, until

from tom.record import Store, layout, lock, manage
from tom.record.files import replace_json
from tom.record.lock import RunLock
from tom.record.status import DEAD_AFTER_S, Status
from tom.record.writer import RunWriter
from tom.sweep.backend import FolderBackend
from tom.sweep.driver import Driver, Job
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


class TakenOver(FolderBackend):
    """Another process begins to write the run after this sweep has looked at it."""

    other: RunLock

    def begin_anew(self, run_id: str) -> str:
        self.other = lock.acquire(self.store.path / run_id)
        return super().begin_anew(run_id)


class MovedAway(FolderBackend):
    """Another sweep puts the run into the trash after this one has looked at it."""

    def begin_anew(self, run_id: str) -> str:
        manage.trash(self.store, run_id)
        return super().begin_anew(run_id)


def test_a_run_that_another_sweep_takes_over_is_watched(died_early: Store, trial: Trial):
    backend = TakenOver(died_early)
    driver = Driver(backend, [trial], LocalEngine(1), back_off_s=0.0)
    (job,) = driver.jobs
    assert not driver.poll()
    assert (job.state, job.attempts) == ("waiting", 0)
    assert "being written by another process" in job.note
    assert not driver.poll()
    assert job.state == "elsewhere"
    backend.other.close()
    assert manage.trashed(died_early) == []


def test_a_run_that_another_sweep_puts_into_the_trash_is_tried_again(
    died_early: Store, trial: Trial
):
    driver = Driver(MovedAway(died_early), [trial], LocalEngine(1), back_off_s=LONG_S)
    (job,) = driver.jobs
    assert not driver.poll()
    assert (job.state, job.attempts) == ("waiting", 0)
    assert "by another process" in job.note
    assert manage.trashed(died_early) == [trial.run_id]


def refused(driver: Driver, words: list[str]) -> Job:
    """The job after `tom train WORDS` was refused in its place."""
    (job,) = driver.jobs
    job.process = driver._spawn(driver.backend.words(job.run_id, words), job.log)
    job.state, job.attempts = "running", 1
    until(lambda: job.process is None or job.process.poll() is not None)
    return job


@pytest.fixture
def driver(died_early: Store, trial: Trial) -> Iterator[Driver]:
    made = Driver(FolderBackend(died_early), [trial], LocalEngine(1), back_off_s=LONG_S)
    yield made
    made.stop()


def test_a_training_that_found_its_run_locked_for_a_moment_is_tried_again(driver: Driver):
    """As by `tom runs repair`, or by a sweep that looks at the run."""
    held = lock.acquire(driver.store.path / driver.jobs[0].run_id)
    job = refused(driver, [f"--resume={driver.jobs[0].run_id}"])
    held.close()
    driver.poll()
    assert "is being written" in job.note
    assert (job.state, job.attempts) == ("waiting", 0)


def test_a_training_whose_run_another_sweep_began_first_is_tried_again(
    driver: Driver, trial: Trial
):
    job = refused(driver, [*trial.options(), f"--run-id={trial.run_id}"])
    driver.poll()
    assert "exists already" in job.note
    assert (job.state, job.attempts) == ("waiting", 1)


def test_a_training_whose_run_another_sweep_put_into_the_trash_is_tried_again(
    driver: Driver, trial: Trial
):
    driver.jobs[0].step = 10  # it had a checkpoint when it was started
    manage.trash(driver.store, trial.run_id)
    job = refused(driver, [f"--resume={trial.run_id}"])
    driver.poll()
    assert "no run" in job.note
    assert (job.state, job.attempts) == ("waiting", 1)


@pytest.mark.parametrize("off_s", [-1e4, 0.0, 1e4])
def test_a_run_of_another_machine_is_watched_whatever_its_clock_says(
    off_s: float, died_early: Store, trial: Trial
):
    run, now = died_early.run(trial.run_id), 0.0
    (run.path / layout.LOCK).write_text("another machine")
    backend = FolderBackend(died_early, lambda: now)
    for beat in range(3):
        beats = Status("running", heartbeat=time.time() + off_s + beat)
        replace_json(run.path / layout.STATUS, asdict(beats), sync=False)
        assert backend.written(died_early.run(trial.run_id))
        now += DEAD_AFTER_S - 1.0
        assert backend.written(died_early.run(trial.run_id))
    now += 1.0
    assert not backend.written(died_early.run(trial.run_id))


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
