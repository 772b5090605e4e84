"""Sweeps of real trainings that are killed, interrupted, starved of disk, or that always fail."""

import subprocess
import sys
from pathlib import Path

import pytest
from common import change
from sweeping import (
    EVERY,
    STEPS,
    assert_same_runs,
    beyond_a_checkpoint,
    finish,
    plan,
    until,
)

from tom.record import Store
from tom.sweep.driver import Driver, FolderBackend
from tom.sweep.engine import LocalEngine
from tom.training.plan import Trial

pytestmark = pytest.mark.fault


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Store:
    """The whole sweep, run in peace."""
    store = Store(tmp_path_factory.mktemp("undisturbed"))
    finish(Driver(FolderBackend(store), plan(), LocalEngine(2)))
    return store


def command(store: Path) -> list[str]:
    words = ["--env", "inverted-pendulum", "--learner", "mle", "pmac", "tom", "--seeds", "0", "1"]
    words += ["--steps", str(STEPS), "--preset", "smoke", "--checkpoint-every", str(EVERY)]
    return [sys.executable, "-m", "tom", "sweep", *words, "--jobs", "2", "--store", str(store)]


def test_trainings_of_a_sweep_killed__go_on_to_the_same_numbers(tmp_path: Path, undisturbed: Store):
    driver = Driver(FolderBackend(Store(tmp_path)), plan(), LocalEngine(2), back_off_s=0.1)
    until(lambda: beyond_a_checkpoint(driver.store), driver.poll)
    killed = [job for job in driver.jobs if job.process]
    for job in killed:
        assert job.process
        job.process.kill()
    finish(driver)
    assert [job.state for job in driver.jobs] == ["finished"] * 6
    assert_same_runs(driver.store, undisturbed)


def test_the_driver_of_a_sweep_killed__stops_its_trainings_and_the_same_command_goes_on(
    tmp_path: Path, undisturbed: Store
):
    store = Store(tmp_path)
    driver = subprocess.Popen(command(tmp_path))
    until(lambda: beyond_a_checkpoint(store))
    driver.kill()
    driver.wait()
    until(lambda: not any(run.status.alive for run in store.runs()))
    assert "stopped" in {run.status.state for run in store.runs()}
    assert subprocess.run(command(tmp_path), check=False).returncode == 0
    assert_same_runs(store, undisturbed)


def test_a_training_that_fails_for_a_reason_of_its_own__is_tried_once_and_stops_nobody(
    tmp_path: Path,
):
    """Networks that no memory holds: another attempt would end like the first."""
    bad = plan(learner=["mle"], seeds=[0], settings={"sac": {"hidden": 10**8}})
    good = plan(learner=["mle"], seeds=[0])
    driver = Driver(FolderBackend(Store(tmp_path)), [*bad, *good], LocalEngine(1), back_off_s=0.1)
    finish(driver)
    failed, finished = driver.jobs
    assert (failed.state, finished.state) == ("failed", "finished")
    assert failed.attempts == 1
    assert "memory" in failed.note
    assert failed.log.read_text().count("$ tom train") == 1


def stopped(store: Path) -> Trial:
    """A training that a sweep into `store` has stopped beyond its first checkpoint."""
    (trial,) = plan(learner=["mle"], seeds=[0], steps=1500)
    driver = Driver(FolderBackend(Store(store)), [trial], LocalEngine(1))
    until(lambda: beyond_a_checkpoint(driver.store), driver.poll)
    driver.stop()
    assert driver.jobs[0].state == "stopped"
    return trial


def test_a_run_that_is_refused_for_now__is_reported_and_kept(tmp_path: Path):
    trial = stopped(tmp_path)
    path = tmp_path / trial.run_id / "config.json"
    whole = path.read_text()
    change(path, plugins=["mine.py"])
    second = Driver(FolderBackend(Store(tmp_path)), [trial], LocalEngine(1), back_off_s=0.1)
    finish(second)
    assert (second.jobs[0].state, second.jobs[0].attempts) == ("failed", 1)
    assert "made with the plug-in mine.py" in second.jobs[0].note
    assert not (tmp_path / ".trash").exists()
    path.write_text(whole)
    third = Driver(FolderBackend(Store(tmp_path)), [trial], LocalEngine(1))
    finish(third)
    assert third.jobs[0].state == "finished"
    assert third.store.run(trial.run_id).config["resumes"]
