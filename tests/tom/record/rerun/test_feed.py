"""Viewers get what running runs write, whenever they come."""

import json
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from recorded import Config, events, logged
from rerun.chunk import RrdReader

from tom.events import Metrics
from tom.record import RunReader, Store
from tom.record.recorder import Recorder
from tom.record.rerun.feed import Follower, Tail, stream
from tom.record.writer import RunWriter


def rows(parts: Iterable[bytes], folder: Path, of: str) -> pd.DataFrame:
    """What a viewer is sent of one entity; each part is a file of its own."""
    found = []
    for part in filter(None, parts):
        (folder / "part.rrd").write_bytes(part)
        table = logged(folder / "part.rrd", of)
        found += [] if table.empty else [table]
    return pd.concat(found)


def test_a_viewer_that_comes_late_gets_the_whole_run(store: Store, tmp_path: Path):
    with Recorder(RunWriter.create(store, "run", Config)) as recorder:
        for event in events():
            recorder.consume(event)
    parts = list(stream(store.run("run")))
    want = store.run("run").metrics()
    table = rows(parts, tmp_path, "model/holdout_nll")
    assert table["env_step"].tolist() == want["env_step"].tolist()
    values = [value[0] for value in table["Scalars:scalars"]]
    np.testing.assert_allclose(values, want["model/holdout_nll"])
    assert len(rows(parts, tmp_path, "weights/profile")) == 10


def test_a_stream_grows_with_the_run_and_ends_with_it(store: Store, tmp_path: Path):
    recorder = Recorder(RunWriter.create(store, "run", Config))
    given = events()
    for event in given[:600]:
        recorder.consume(event)
    parts = stream(store.run("run"))
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


def test_of_a_run_that_has_nothing_yet_the_layout_is_streamed(record):
    pieces = list(Follower(record(given=[])).pieces())
    assert [piece[:4] for piece in pieces] == [b"RRF2"]


def test_a_viewer_that_comes_late_gets_many_rows_in_one_chunk(store: Store, tmp_path: Path):
    with Recorder(RunWriter.create(store, "run", Config)) as recorder:
        for step in range(1, 201):
            recorder.consume(Metrics(step, {"model/train_nll": 1.0 / step}))
    (tmp_path / "run.rrd").write_bytes(b"".join(stream(store.run("run"))))
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
    assert sum(map(len, stream(RunReader(run.path)))) > 10_000
