"""A hub is fed with what running runs write, whenever it comes up."""

import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from recorded import FIT, STEPS, Config, events, logged
from rerun.chunk import RrdReader

from tom.events import Metrics
from tom.record import Recorder, RunWriter, Store, layout
from tom.record.rerun import feed
from tom.record.rerun.feed import Feeder, Follower, Tail, stream
from tom.record.rerun.hub import binary, free_port, without_analytics


@contextmanager
def hub(path: Path, port: int) -> Iterator[None]:
    """A real Rerun server that saves what it is sent to `path`."""
    environment = without_analytics(path.parent)
    command = [str(binary()), "--bind", "127.0.0.1", "--port", str(port), "--save", str(path)]
    process = subprocess.Popen(command, env=environment, stderr=subprocess.DEVNULL)
    try:
        yield
    finally:
        process.terminate()
        process.wait()


def wait(found: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 20
    while not found():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def profiles_in(path: Path) -> int:
    """The weight profiles in a file that a hub is still writing; 0 while its last frame is half."""
    try:
        return len(logged(path, "weights/profile"))
    except RuntimeError:
        return 0


def test_a_hub_that_comes_late_gets_the_whole_run_and_follows_it(store: Store, tmp_path: Path):
    port, saved = free_port("127.0.0.1"), tmp_path / "saved.rrd"
    feeder = Feeder(store, "127.0.0.1", port)
    assert not feeder.hub_answers()
    recorder = Recorder(RunWriter.create(store, "run", Config))
    given = events()
    for event in given[:600]:
        recorder.consume(event)
    with hub(saved, port):
        wait(feeder.hub_answers)
        feeder.poll()
        for event in given[600:]:
            recorder.consume(event)
        recorder.finish("finished")
        feeder.poll()
        assert feeder.followed == []
        feeder.poll()  # the run is over: it is not sent again
        assert feeder.followed == []
        wait(lambda: saved.exists() and profiles_in(saved) == 10)
    want = store.run("run").metrics()
    table = logged(saved, "model/holdout_nll")
    assert table["env_step"].tolist() == want["env_step"].tolist()
    values = [value[0] for value in table["Scalars:scalars"]]
    np.testing.assert_allclose(values, want["model/holdout_nll"])


def test_a_run_that_cannot_be_shown_does_not_stop_the_others(store: Store, tmp_path: Path):
    port, saved = free_port("127.0.0.1"), tmp_path / "saved.rrd"
    feeder = Feeder(store, "127.0.0.1", port)
    recorders = [Recorder(RunWriter.create(store, run_id, Config)) for run_id in ("a", "b")]
    for recorder in recorders:
        for event in events():
            recorder.consume(event)
    with (store.path / "a" / "weights" / "profiles.jsonl").open("a") as file:
        file.write('{"env_step": 7, "bins": "none"}\n')
    with hub(saved, port):
        wait(feeder.hub_answers)
        feeder.poll()
        assert feeder.followed == ["b"]
        for recorder in recorders:
            recorder.finish("finished")
        feeder.poll()
    assert feeder.followed == []


def test_a_stream_grows_with_the_run_and_ends_with_it(store: Store, tmp_path: Path):
    recorder = Recorder(RunWriter.create(store, "run", Config))
    given = events()
    for event in given[:600]:
        recorder.consume(event)
    parts = stream(store.run("run"), threading.Event())
    begun = store.run("run").profiles().env_step.tolist()
    got: list[int] = []
    while got != begun:
        got += _steps(next(parts), tmp_path)
    for event in given[600:]:
        recorder.consume(event)
    recorder.finish("finished")
    for part in parts:
        got += _steps(part, tmp_path)
    assert got == store.run("run").profiles().env_step.tolist() != begun


def test_a_long_run_is_streamed_in_pieces(
    store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(feed, "BLOCK_BYTES", 100)  # two rows of metrics
    with Recorder(RunWriter.create(store, "run", Config)) as recorder:
        for event in events():
            recorder.consume(event)
    rows = (store.run("run").path / layout.METRICS).read_bytes().splitlines()
    parts = list(stream(store.run("run"), threading.Event()))
    metric = "model/holdout_nll"
    steps = [found for part in parts if (found := _steps(part, tmp_path, metric))]
    assert len(steps) >= len(rows) / 3 > 3
    assert [step for part in steps for step in part] == list(range(FIT, STEPS + 1, FIT))
    profiles = [step for part in parts for step in _steps(part, tmp_path)]
    assert profiles == store.run("run").profiles().env_step.tolist()


def test_of_a_run_that_has_nothing_yet_the_layout_is_streamed(record):
    pieces = list(Follower(record(given=[])).pieces())
    assert [piece[:4] for piece in pieces] == [b"RRF2"]


def test_a_viewer_that_comes_late_gets_many_rows_in_one_chunk(store: Store, tmp_path: Path):
    with Recorder(RunWriter.create(store, "run", Config)) as recorder:
        for step in range(1, 201):
            recorder.consume(Metrics(step, {"model/train_nll": 1.0 / step}))
    (tmp_path / "run.rrd").write_bytes(b"".join(stream(store.run("run"), threading.Event())))
    chunks = [
        chunk.to_record_batch()
        for chunk in RrdReader(tmp_path / "run.rrd").stream()
        if chunk.entity_path == "/model/train_nll"
    ]
    assert [chunk.num_rows for chunk in chunks] == [200]


def _steps(part: bytes, folder: Path, of: str = "weights/profile") -> list[int]:
    if not part:
        return []
    (folder / "part.rrd").write_bytes(part)
    table = logged(folder / "part.rrd", of)
    return [] if table.empty else table["env_step"].tolist()


def test_a_tail_gives_each_whole_row_once(tmp_path: Path):
    path = tmp_path / "m"
    tail = Tail(path)
    assert list(tail.blocks()) == []
    path.write_bytes(b'{"env_step":1}\n{"env_st')
    assert list(tail.blocks()) == [[{"env_step": 1}]]
    assert list(tail.blocks()) == []
    with path.open("ab") as file:
        file.write(b'ep":2}\nrubbish\n{"env_step":3}\n')
    assert list(tail.blocks()) == [[{"env_step": 2}, {"env_step": 3}]]


def test_a_file_that_was_cut_is_read_from_its_beginning(tmp_path: Path):
    path = tmp_path / "m"
    path.write_text('{"env_step":1}\n{"env_step":2}\n{"env_step":3}\n')
    tail = Tail(path)
    assert len(next(iter(tail.blocks()))) == 3
    path.write_text('{"env_step":1}\n{"env_step":2}\n')  # resumed from step 2
    assert list(tail.blocks()) == [[{"env_step": 1}, {"env_step": 2}]]
