"""Sweeps of real trainings that are killed, interrupted, starved of disk, or that always fail."""

import json
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest
from sweeping import (
    EVERY,
    STEPS,
    WAIT_S,
    assert_same_runs,
    beyond_a_checkpoint,
    finish,
    plan,
    until,
)

from tom.errors import TRY_LATER
from tom.record import Store, checkpoint
from tom.sweep.driver import ATTEMPTS, Driver, FolderBackend
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


def test_ctrl_c_in_a_sweep__stops_everything_and_the_same_command_goes_on(
    tmp_path: Path, undisturbed: Store
):
    store = Store(tmp_path)
    driver = subprocess.Popen(
        command(tmp_path),
        stdout=subprocess.PIPE,
        text=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_IGN),  # as after a shell's `&`
    )
    until(lambda: beyond_a_checkpoint(store))
    driver.send_signal(signal.SIGINT)
    out, _ = driver.communicate(timeout=WAIT_S)
    assert driver.returncode == 1
    assert "the same command goes on" in out
    assert not any(run.status.alive for run in store.runs())
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
    path.write_text(json.dumps(json.loads(whole) | {"plugins": ["mine.py"]}))
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


def test_a_run_that_cannot_be_read_for_now__is_tried_again_and_kept(tmp_path: Path):
    trial = stopped(tmp_path)
    store = Store(tmp_path)
    for folder in checkpoint.folders(tmp_path / trial.run_id / checkpoint.FOLDER):
        (folder / "manifest.json").rename(folder / "kept")
        with socket.socket(socket.AF_UNIX) as there:  # to open one is an error of the device
            there.bind(str(tmp_path / "socket"))
        (tmp_path / "socket").rename(folder / "manifest.json")
    second = Driver(FolderBackend(store), [trial], LocalEngine(1), back_off_s=0.1)
    finish(second)
    assert (second.jobs[0].state, second.jobs[0].attempts) == ("failed", ATTEMPTS)
    assert f"exit code {TRY_LATER}" in second.jobs[0].note
    assert not (tmp_path / ".trash").exists()
    for folder in checkpoint.folders(tmp_path / trial.run_id / checkpoint.FOLDER):
        (folder / "kept").rename(folder / "manifest.json")
    third = Driver(FolderBackend(store), [trial], LocalEngine(1))
    finish(third)
    assert third.jobs[0].state == "finished"
    assert third.store.run(trial.run_id).config["resumes"]


def fill(path: Path) -> None:
    """Write into `path` until the disk is full."""
    with path.open("wb") as file, suppress(OSError):
        while os.write(file.fileno(), bytes(65536)):
            pass


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of its own with little room; needs root."""
    folder = tmp_path / "disk"
    folder.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", "size=12m", "tmpfs", folder], check=True)
    yield folder
    subprocess.run(["umount", "-l", folder], check=True)


def test_disk_full_during_a_sweep__waits_for_room_and_ends_with_the_same_numbers(
    small_disk: Path, undisturbed: Store
):
    store = Store(small_disk / "store")
    driver = Driver(FolderBackend(store), plan(), LocalEngine(2), low_bytes=500_000, back_off_s=0.1)
    until(lambda: beyond_a_checkpoint(store), driver.poll)
    ballast = small_disk / "somebody's film"
    fill(ballast)
    until(lambda: not any(job.process for job in driver.jobs), driver.poll)
    assert driver.full
    assert "failed" not in [job.state for job in driver.jobs]
    ballast.unlink()
    finish(driver)
    assert_same_runs(store, undisturbed)
