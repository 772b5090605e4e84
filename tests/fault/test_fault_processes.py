"""kill -9 at random points, signals to stop, several processes and machines, wrong clocks."""

import os
import shutil
import signal
import threading
import time
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from common import change, stopping_at
from faults import (
    config,
    ended,
    go_on,
    one_line,
    stopped,
    tom,
    train_command,
    wait_until,
)
from kernel import alive, descendants
from same_records import assert_same_record, untimed

from tom.errors import UserError
from tom.events import Tick
from tom.record import RunReader, Store, checkpoint, manage
from tom.record.lock import LostError
from tom.training.resume import resume
from tom.training.run import train

pytestmark = pytest.mark.fault


def killed_often(path: Path, kills: int, *, rerun: bool) -> RunReader:
    """A run killed so many times, each time read, and gone on with from its checkpoint."""
    rng = np.random.default_rng(kills)
    steps = 80 + 30 * kills  # more than the kills let it come to, on a busy machine too
    truth = train(config("tom", steps=steps), Store(path / "truth"), "a", rerun=False)
    store = Store(path / "killed")
    store.path.mkdir()
    (store.path / "step").write_bytes(b"%09d" % 0)
    processes = get_context("forkserver")
    processes.set_forkserver_preload(["tom.training.run"])
    for _ in range(kills):
        begun = done(store)
        process = processes.Process(target=go_on, args=(store.path, "a", steps, rerun))
        process.start()
        target = begun + int(rng.integers(1, 25))
        wait_until(lambda p=process, t=target: done(store) >= t or not p.is_alive())
        process.join(float(rng.exponential(0.004)))  # anywhere within a step
        process.kill()
        process.join()
        assert process.exitcode == -signal.SIGKILL
        check(truth, store, done(store))
        if checkpoint.newest(store.path / "a" / checkpoint.FOLDER) is None:
            shutil.rmtree(store.path / "a")  # killed before there was anything to go on from
    return resume(store, "a", steps, rerun=rerun)


def done(store: Store) -> int:
    """The last step that was recorded whole."""
    return int((store.path / "step").read_bytes())


def check(truth: RunReader, store: Store, step: int) -> None:
    """Everything of the whole steps is there, and what is there is right."""
    [run] = store.runs()
    # What is measured after a step belongs to it, so the rows before the last one are complete.
    # The exam of the last fit is told when the next one begins: it is held once the run is done.
    want, got = (
        table.loc[table["env_step"] < step, ~table.columns.str.startswith("exam/")].dropna(
            axis="columns", how="all"
        )
        for table in (untimed(truth), untimed(run))
    )
    pd.testing.assert_frame_equal(want, got)
    rows = run.buffer()[0]
    if len(rows):
        np.testing.assert_array_equal(rows.obs, truth.buffer()[0].obs[: len(rows)])
    for at in run.evaluation_steps():
        assert run.episodes(at)
    for at in run.snapshot_steps():
        assert len(run.snapshot(at)) > 0
    assert all("half written" in problem for problem in run.problems), run.problems


@pytest.mark.quick
def test_kill_9_twice__the_store_is_readable_and_resume_ends_as_if_undisturbed(
    tmp_path: Path,
):
    run = killed_often(tmp_path, 2, rerun=False)
    assert_same_record(RunReader(tmp_path / "truth" / "a"), run)


def test_kill_9_fifty_times_with_rerun__at_most_the_last_flush_is_lost_and_resume_goes_on(
    tmp_path: Path,
):
    run = killed_often(tmp_path, 50, rerun=True)
    assert_same_record(RunReader(tmp_path / "truth" / "a"), run)
    assert len(run.rrd_files()) > 2
    left = [path.name for path in run.path.rglob(".*.tmp")]
    assert left == [], "what a killed writer left half-done is cleared by the next"


def test_a_signal_to_stop__a_checkpoint_is_written_and_resume_auto_ends_as_if_undisturbed(
    tmp_path: Path,
):
    truth = train(config(steps=700), Store(tmp_path / "truth"), "a", rerun=False)
    command = train_command(tmp_path / "store", steps=700)
    process = tom(*command, "--resume", "auto", "--run-id", "a")
    run = RunReader(tmp_path / "store" / "a")
    wait_until(lambda: run.path.exists() and len(run.metrics()) > 2)
    process.terminate()
    code, _, error = ended(process)
    assert code == 1, error
    assert run.status.state == "stopped"
    assert checkpoint.newest(run.path / checkpoint.FOLDER) == run.status.env_step
    assert "tom train --resume a" in run.status.reason
    assert ended(tom(*command, "--resume", "auto"))[0] == 0
    assert [reader.run_id for reader in Store(tmp_path / "store").runs()] == ["a"]
    assert_same_record(truth, Store(tmp_path / "store").run("a"))


def test_killed_before_its_first_checkpoint__resume_auto_starts_a_new_run_and_keeps_the_old(
    tmp_path: Path,
):
    command = train_command(tmp_path / "store", checkpoint_every=0, steps=700)
    process = tom(*command, "--resume", "auto", "--run-id", "a")
    run = RunReader(tmp_path / "store" / "a")
    wait_until(lambda: run.path.exists() and len(run.metrics()) > 1)
    process.kill()
    ended(process)
    assert ended(tom(*command, "--resume", "auto"))[0] == 0
    assert len(Store(tmp_path / "store").runs()) == 2
    assert len(run.metrics()) > 1


# Several processes, several machines and clocks that go wrong


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
    stop = threading.Event()

    def beat() -> None:
        while not stop.wait(0.02):
            change(run.path / "status.json", state="running", heartbeat=time.time() + ahead_s)

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
        change(run.path / "status.json", heartbeat=0.0)
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
