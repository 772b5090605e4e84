"""kill -9 at any moment: everything stays readable, and at most the last row is missing."""

import os
import signal
import time
from itertools import count
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pytest
from recorded import Config, episodes, transitions, weights

from tom.events import Collected, Evaluation, Metrics, Tick
from tom.record import RunReader, Store
from tom.record.recorder import Recorder
from tom.record.writer import RunWriter


def _write(path: Path) -> None:
    """Record as fast as possible; the last whole step is in `path`/step."""
    recorder = Recorder(RunWriter.create(Store(path), "run", Config))
    with (path / "step").open("wb", buffering=0) as done:
        for step in count(1):
            recorder.consume(Collected(step, transitions(step - 1, 1), np.array([step])))
            recorder.consume(weights(step))
            recorder.consume(Metrics(step, {"critic/loss": step / 2}))
            recorder.consume(Evaluation(step, episodes(step)))
            recorder.consume(Tick(step, "optimise"))
            os.pwrite(done.fileno(), b"%012d" % step, 0)


@pytest.mark.parametrize("attempt", range(2))
def test_a_killed_run_is_readable(tmp_path: Path, attempt: int):
    writer = get_context("fork").Process(target=_write, args=(tmp_path,), daemon=True)
    writer.start()
    while not (tmp_path / "step").exists() or not (tmp_path / "step").read_bytes():
        assert writer.is_alive()
        time.sleep(0.001)
    time.sleep(np.random.default_rng(attempt).uniform(0.05, 0.3))
    assert writer.pid is not None
    os.kill(writer.pid, signal.SIGKILL)
    writer.join()
    _check(Store(tmp_path).run("run"), int((tmp_path / "step").read_bytes()))


def _check(run: RunReader, done: int) -> None:
    steps = np.arange(1, done + 1)
    table = run.metrics().iloc[:done]
    np.testing.assert_array_equal(table["env_step"], steps)
    np.testing.assert_array_equal(table["critic/loss"], steps / 2)
    np.testing.assert_array_equal(run.profiles().count[:done], steps)
    np.testing.assert_array_equal(run.buffer()[0].reward[:done], steps - 1)
    assert run.evaluation_steps()[:done] == steps.tolist()
    assert all(run.episodes(step) for step in run.evaluation_steps()[-3:])
    newest = run.snapshot_steps()[-1]
    assert newest >= done
    assert len(run.snapshot(newest)) == newest
    assert run.status.state == "running"
    assert run.problems == []
