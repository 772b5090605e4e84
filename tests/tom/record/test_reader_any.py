"""Whatever the files of a run folder hold, reading them raises nothing."""

import json
import shutil
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from recorded import Config, events

from tom.record import RunReader, Store
from tom.record.recorder import Recorder
from tom.record.writer import RunWriter

NUMBERS = st.one_of(
    st.integers(), st.floats(), st.sampled_from([10**30, -(2**63), 2**63, 1e308, -0.0])
)
WORDS = st.sampled_from(["", "running", "hopper", "tom", "../..", "\x00", "NaN", "1e3"])
NAMES = (
    *("schema", "config", "total", "reason", "ess", "name", "started"),
    *("env", "created", "heartbeat", "eta_s", "zeros", "note", "phase"),
    *("learner", "state", "pid", "bins", "kind", "tags", "steps"),
    *("seed", "env_step", "warnings", "count", "message", "eval/return", "versions"),
)
KEYS = st.sampled_from(NAMES)
JSON = st.recursive(
    st.one_of(st.none(), st.booleans(), NUMBERS, WORDS),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(KEYS, inner, max_size=6),
    max_leaves=12,
)
CONTENT = st.one_of(
    JSON.map(lambda value: json.dumps(value).encode()),
    st.dictionaries(KEYS, JSON, max_size=12).map(lambda value: json.dumps(value).encode()),
    st.binary(max_size=60),
    st.just(b"[" * 100_000),
    st.just(b'{"env_step":' + b'{"a":' * 100_000),
    st.just(b'{"env_step":1e999}'),
)
LINES = st.lists(CONTENT, max_size=4).map(b"\n".join)
FILES = ("config.json", "status.json", "labels.json")
ROWS = ("metrics.jsonl", "notices.jsonl", "weights/profiles.jsonl")


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    store = Store(tmp_path_factory.mktemp("any"))
    with Recorder(RunWriter.create(store, "run", Config)) as recorder:
        for event in events()[:300]:
            recorder.consume(event)
    (store.path / "run" / "metrics.parquet").unlink()
    return store.path


def read_all(path: Path) -> None:
    """Everything that the pages and the command line ask of a store."""
    store = Store(path)
    for run in [*store.runs(), RunReader(path / "run")]:
        assert isinstance(run.is_run, bool)
        assert isinstance(run.env + run.learner + run.created, str)
        assert isinstance(run.seed, int)
        assert run.status.shown in ("running", "finished", "stopped", "failed", "dead", "unknown")
        assert 0 <= run.status.share <= 1
        assert "env_step" in run.metrics()
        assert len(run.profiles().bins) == len(run.profiles().env_step)
        assert isinstance(run.notices(), list)
        assert run.labels is not None
        run.buffer()
        run.buffer_state()
        for step in run.evaluation_steps():
            run.episodes(step)
        assert all(isinstance(problem, str) for problem in run.problems)


def check(recorded: Path, name: str, content: bytes, large: bool) -> None:
    path = recorded / "run" / name
    before = path.read_bytes() if path.exists() else None
    path.write_bytes(content)
    with pytest.MonkeyPatch.context() as patched:
        if large:
            patched.setattr("tom.record.rows.LARGE_BYTES", 0)
        try:
            read_all(recorded)
        finally:
            path.unlink() if before is None else path.write_bytes(before)


def one_of_them(data: Any) -> tuple[str, bytes]:
    name = data.draw(st.sampled_from((*FILES, *ROWS)))
    return name, data.draw(LINES if name in ROWS else CONTENT)


@settings(max_examples=60, deadline=None)
@given(data=st.data(), large=st.booleans())
def test_any_content_of_a_file_is_read_or_named(recorded: Path, data: st.DataObject, large: bool):
    check(recorded, *one_of_them(data), large)


@pytest.mark.fault
@settings(max_examples=600, deadline=None)
@given(data=st.data(), large=st.booleans())
def test_any_json_or_bytes_in_a_run_folder__are_read_or_named_and_raise_nothing(
    recorded: Path, data: st.DataObject, large: bool
):
    check(recorded, *one_of_them(data), large)


@pytest.mark.parametrize("suffix", [".npz", ".parquet"])
def test_any_bytes_in_an_array_file_are_named(recorded: Path, tmp_path: Path, suffix: str):
    store = shutil.copytree(recorded, tmp_path / "store")
    for path in (store / "run").rglob(f"*{suffix}"):
        content = path.read_bytes()
        for damage in (b"", b"PK\x03\x04", content[:40], content[::-1], b"PAR1" + bytes(8)):
            path.write_bytes(damage)
            read_all(store)
            run = RunReader(store / "run")
            for step in run.snapshot_steps():
                run.snapshot(step)
        path.write_bytes(content)


@pytest.mark.parametrize("line", [b"null", b"1", b"", b'"a"', b"}", b"\x00"])
def test_a_large_file_with_a_line_that_is_no_object_takes_nobody_down(
    recorded: Path, line: bytes, monkeypatch: pytest.MonkeyPatch
):
    """Arrow's parser ends the whole process at a bare `null`."""
    monkeypatch.setattr("tom.record.rows.LARGE_BYTES", 0)
    path = recorded / "run" / "metrics.jsonl"
    before = path.read_bytes()
    try:
        path.write_bytes(before + line + b"\n")
        reader = RunReader(path.parent)
        assert len(reader.metrics()) == len(before.splitlines())
        assert bool(reader.problems) == bool(line)
    finally:
        path.write_bytes(before)
