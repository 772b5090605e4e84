"""Several processes, several machines and clocks that go wrong."""

import json
import os
import signal
import threading
import time
from pathlib import Path

import pytest
from common import stopping_at
from faults import (
    config,
    ended,
    one_line,
    stopped,
    tom,
    wait_until,
)
from kernel import alive, descendants
from same_records import assert_same_record

from tom.errors import UserError
from tom.events import Tick
from tom.record import RunReader, Store, manage
from tom.record.lock import LostError
from tom.training.resume import resume
from tom.training.run import train

pytestmark = pytest.mark.fault


def test_two_processes_that_resume_the_same_run__one_goes_on_the_other_is_refused_in_one_line(
    tmp_path: Path,
):
    stopped(Store(tmp_path), 130, steps=2000)
    command = ("train", "--resume", "a", "--store", tmp_path, "--no-rerun", "--steps", 1500)
    results = [ended(p) for p in [tom(*command) for _ in range(2)]]
    (_, refused) = sorted(results)
    assert sorted(results)[0][0] == 0
    # Try later, while the other writes; once it has ended there is nothing left to do.
    assert refused[0] == (75 if "written by another process" in one_line(refused[2]) else 2)
    assert Store(tmp_path).run("a").status.env_step == 1500


@pytest.mark.parametrize("ahead_s", [0.0, -3600.0, 3600.0])
def test_a_run_written_on_another_machine_with_any_clock__resume_is_refused_while_its_heart_beats(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ahead_s: float
):
    monkeypatch.setattr("tom.record.lock.BEAT_S", 0.1)
    run = stopped(Store(tmp_path), 130)
    (run.path / ".writer").write_text("the boot of another machine")
    status = json.loads((run.path / "status.json").read_text())
    stop = threading.Event()

    def beat() -> None:
        while not stop.wait(0.02):
            beating = {**status, "state": "running", "heartbeat": time.time() + ahead_s}
            (run.path / "status.tmp").write_text(json.dumps(beating))
            (run.path / "status.tmp").replace(run.path / "status.json")

    heart = threading.Thread(target=beat)
    heart.start()
    wait_until(lambda: RunReader(run.path).status.state == "running")
    try:
        with pytest.raises(UserError, match="on another machine: stop it there"):
            resume(Store(tmp_path), "a", rerun=False)
        with pytest.raises(UserError, match="on another machine: stop it there"):
            manage.trash(Store(tmp_path), "a")
    finally:
        stop.set()
        heart.join()
    assert resume(Store(tmp_path), "a", rerun=False).status.state == "finished"


@pytest.mark.quick
def test_a_writer_thought_dead_wakes_after_another_machine_took_over__it_writes_no_more(
    tmp_path: Path,
):
    """A paused machine: its lock is not seen elsewhere, its run has gone on and ended there."""
    store = Store(tmp_path)

    def taken_over(event: object) -> None:
        run = store.run("a")
        if run.status.state == "finished" or event != Tick(130, "optimise"):
            return
        (run.path / ".writer").unlink()
        (run.path / ".writer").write_text("the boot of another machine")
        status = json.loads((run.path / "status.json").read_text())
        (run.path / "status.json").write_text(json.dumps({**status, "heartbeat": 0.0}))
        assert resume(store, "a", rerun=False).status.state == "finished"
        (run.path / "before").write_bytes((run.path / "metrics.jsonl").read_bytes())

    with pytest.raises(LostError):
        train(config(), store, "a", rerun=False, watchers=(taken_over,))
    run = store.run("a")
    assert run.status.state == "finished"
    assert (run.path / "metrics.jsonl").read_bytes() == (run.path / "before").read_bytes()
    assert_same_record(run, train(config(), store, "b", rerun=False))


@pytest.mark.quick
def test_asked_twice_to_stop__ends_at_once_as_stopped_and_the_last_checkpoint_serves(
    tmp_path: Path,
):
    stop, (ask,) = stopping_at(130)

    def twice(event: object) -> None:
        ask(event)  # pyright: ignore[reportArgumentType]
        if stop.asked:
            stop()

    with pytest.raises(KeyboardInterrupt):
        train(config(), Store(tmp_path), "a", rerun=False, watchers=(twice,), stop=stop)
    run = RunReader(tmp_path / "a")
    assert (run.status.state, run.status.reason) == ("stopped", "interrupted")
    assert resume(Store(tmp_path), "a", rerun=False).status.state == "finished"


@pytest.mark.quick
def test_a_terminal_that_is_gone__the_training_goes_on(tmp_path: Path):
    def gone(event: object) -> None:
        raise OSError(5, "Input/output error")

    run = train(config(steps=60), Store(tmp_path), "a", rerun=False, watchers=(gone,))
    assert run.status.state == "finished"


def test_a_study_killed_with_kill_9__its_processes_end_too(tmp_path: Path):
    study = tom("reproduce", "tabular", "--seeds", 0, "--jobs", 1, "--out", tmp_path)
    seen: set[int] = set()
    try:
        # multiprocessing's resource tracker, and the one that computes
        wait_until(lambda: len(descendants(study.pid)) == 2)
        seen = descendants(study.pid)
        study.kill()
        study.wait()
        wait_until(lambda: not any(map(alive, seen)), seconds=30)
    finally:
        for pid in filter(alive, seen):
            os.kill(pid, signal.SIGKILL)
        study.communicate()
