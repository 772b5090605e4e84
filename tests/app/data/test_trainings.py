"""Trainings are started, stopped by name only, and known to be gone, on real processes."""

import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from kernel import wait_for
from studio_runs import PENDULUM_TOM

from app.data import trainings
from app.links import VARIABLE
from tom.errors import UserError
from tom.record.reader import RunReader
from tom.record.store import Store

WAIT_S = 60
SMALL = ["--env", "inverted-pendulum", "--learner", "mle", "--preset", "smoke", "--steps", "100000"]


def test_a_training_is_started_and_stopped(tmp_path: Path) -> None:
    words = ["train", *SMALL, "--store", str(tmp_path), "--run-id", "mine", "--no-rerun"]
    begun = trainings.start(words)
    try:
        wait_for(lambda: RunReader(tmp_path / "mine").status.env_step > 20)
        assert not trainings.has_ended(tmp_path / "mine")
        trainings.stop(Store(tmp_path), "mine")
        begun.process.wait(WAIT_S)
    finally:
        begun.process.kill()
    run = RunReader(tmp_path / "mine")
    assert run.status.state == "stopped"
    assert "resume" in run.status.reason
    assert trainings.has_ended(tmp_path / "mine")
    with pytest.raises(UserError, match="nothing to stop"):
        trainings.stop(Store(tmp_path), "mine")


def test_a_training_does_not_have_the_studios_key(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv(VARIABLE, "the key")
    monkeypatch.setenv("PASSED_ON", "as it is")
    begun = trainings.start(["train", "--help"])
    told = Path(f"/proc/{begun.process.pid}/environ")
    try:
        wait_for(told.read_bytes)  # empty for a moment, between fork and exec
        environment = told.read_bytes()
    finally:
        begun.process.kill()
        begun.process.wait(WAIT_S)
    assert b"PASSED_ON=as it is" in environment
    assert b"the key" not in environment


def test_a_training_that_dies_before_it_has_a_run_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTHONHASHSEED", "no number")  # Python ends with code 1 at once
    begun = trainings.start(["train", *SMALL])
    assert begun.process.wait(WAIT_S) == 1
    assert "PYTHONHASHSEED" in begun.tail()


def test_a_process_that_does_not_write_the_run_is_not_signalled(
    store: Path, tmp_path: Path
) -> None:
    path = shutil.copytree(store / PENDULUM_TOM, tmp_path / PENDULUM_TOM) / "status.json"
    with subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"]) as other:
        fresh = f'"state": "running", "heartbeat": {time.time()}, "pid": {other.pid}'
        path.write_text(f"{{{fresh}}}")
        with pytest.raises(UserError, match="another machine"):
            trainings.stop(Store(tmp_path), PENDULUM_TOM)
        assert other.poll() is None
        os.kill(other.pid, signal.SIGKILL)
