"""kill -9 at random points, and the signals that ask a training to stop."""

import shutil
import signal
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from faults import (
    config,
    ended,
    go_on,
    kill,
    tom,
    train_command,
    wait_until,
)
from same_records import assert_same_record, untimed

from tom.record import RunReader, Store, checkpoint
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
        if process.pid is not None and process.is_alive():
            kill(process.pid)
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
