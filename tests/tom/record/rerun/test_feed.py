"""Viewers get what running runs write, whenever they come."""

import json
import threading
from collections.abc import Callable, Iterable, Iterator
from itertools import takewhile
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from recorded import FIT, STEPS, Config, events, logged
from rerun.chunk import RrdReader

from tom.events import Metrics
from tom.record import RunReader, Store, layout
from tom.record.recorder import Recorder
from tom.record.rerun import feed
from tom.record.rerun.feed import Follower, Tail, stream, stream_all
from tom.record.writer import RunWriter


def rows(parts: Iterable[bytes], folder: Path, of: str) -> pd.DataFrame:
    """What a viewer is sent of one entity; each part is a file of its own."""
    found = []
    for part in filter(None, parts):
        (folder / "part.rrd").write_bytes(part)
        table = logged(folder / "part.rrd", of)
        found += [] if table.empty else [table]
    return pd.concat(found)


def recordings(parts: Iterable[bytes], folder: Path) -> list[str]:
    """Whose part each is."""
    found = []
    for part in filter(None, parts):
        (folder / "part.rrd").write_bytes(part)
        found += [entry.recording_id for entry in RrdReader(folder / "part.rrd").recordings()]
    return found


@pytest.fixture
def new_pieces(store: Store, monkeypatch: pytest.MonkeyPatch) -> Callable[[], list[bytes]]:
    """What a viewer of all running trainings gets until there is nothing new."""
    monkeypatch.setattr(feed, "POLL_S", 0.0)
    pieces = stream_all(store, threading.Event())
    return lambda: list(takewhile(bool, pieces))


def test_a_viewer_that_comes_late_gets_the_whole_run_and_follows_it(
    store: Store, tmp_path: Path, new_pieces
):
    assert new_pieces() == []
    recorder = Recorder(RunWriter.create(store, "run", Config))
    given = events()
    for event in given[:600]:
        recorder.consume(event)
    parts = new_pieces()
    for event in given[600:]:
        recorder.consume(event)
    recorder.finish("finished")
    parts += new_pieces()
    assert new_pieces() == []  # the run is over: it is not sent again
    want = store.run("run").metrics()
    table = rows(parts, tmp_path, "model/holdout_nll")
    assert table["env_step"].tolist() == want["env_step"].tolist()
    values = [value[0] for value in table["Scalars:scalars"]]
    np.testing.assert_allclose(values, want["model/holdout_nll"])
    assert len(rows(parts, tmp_path, "weights/profile")) == 10


def test_two_trainings_go_to_a_viewer_in_one_stream(store: Store, tmp_path: Path, new_pieces):
    recorders = [Recorder(RunWriter.create(store, run_id, Config)) for run_id in ("a", "b")]
    parts: list[bytes] = []
    for event in events():
        for recorder in recorders:
            recorder.consume(event)
        if event.env_step % 100 == 0:
            parts += new_pieces()  # pieces of one follow those of the other
    for recorder in recorders:
        recorder.finish("finished")
    parts += new_pieces()
    whose = recordings(parts, tmp_path)
    assert set(whose) == {"a", "b"}
    assert whose != sorted(whose)


def test_a_run_that_cannot_be_shown_does_not_stop_the_others(
    store: Store, tmp_path: Path, new_pieces, monkeypatch: pytest.MonkeyPatch
):
    for run_id in ("a", "b"):
        with Recorder(RunWriter.create(store, run_id, Config)) as recorder:
            for event in events():
                recorder.consume(event)
    follow = Follower.follow

    def failing(self: Follower) -> Iterator[None]:
        if self.run.run_id == "a":
            raise RuntimeError("no view")
        return follow(self)

    monkeypatch.setattr(Follower, "follow", failing)
    assert set(recordings(new_pieces(), tmp_path)) == {"b"}
    assert new_pieces() == []


def test_a_stream_of_all_that_trains_goes_on_when_nothing_does(store: Store):
    parts = stream_all(store, threading.Event())
    assert next(parts) == b""
    with Recorder(RunWriter.create(store, "run", Config)) as recorder:
        for event in events():
            recorder.consume(event)
        assert next(part for part in parts if part)[:4] == b"RRF2"


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


@pytest.mark.fault
@pytest.mark.quick
def test_a_run_of_an_environment_that_nobody_knows__is_shown_but_for_its_robot(record):
    run = record()
    content = json.loads((run.path / "config.json").read_text())
    content["env"] = content["config"]["env"] = "nosuch"
    (run.path / "config.json").write_text(json.dumps(content))
    assert sum(map(len, stream(RunReader(run.path), threading.Event()))) > 10_000
