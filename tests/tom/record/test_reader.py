"""Damaged, half-written and foreign files: named in `problems`, the rest is read."""

import json
import os
import subprocess
import sys

import numpy as np
import pytest
from common import cut
from recorded import FIT, STEPS

from tom.record import RunReader


def problem(run: RunReader) -> str:
    assert len(run.problems) == 1, run.problems
    return run.problems[0]


def test_truncated_files_are_left_out_and_named(record):
    run = record()
    names = ["episodes/000000500.npz", "weights/snapshot-000000400.parquet", "metrics.parquet"]
    for name in names:
        cut(run.path / name)
    assert [len(run.episodes(step)) for step in (500, 1000)] == [0, 2]
    assert [len(run.snapshot(step)) for step in (400, 700)] == [0, 700]
    assert len(run.metrics()) == STEPS // FIT  # of the rows
    assert [problem.split()[0] for problem in run.problems] == names


def test_rows_that_came_after_the_parquet_copy_are_read(record):
    run = record()
    rows = run.path / "metrics.jsonl"
    with rows.open("a") as file:
        file.write('{"env_step":1100,"critic/loss":2.5}\n')
    later = (run.path / "metrics.parquet").stat().st_mtime_ns + 1
    os.utime(rows, ns=(later, later))
    assert run.metrics()["critic/loss"].iloc[-1] == 2.5


def test_later_rows_of_a_step_win_and_steps_are_in_order(record):
    run = record(given=[])
    (run.path / "metrics.parquet").unlink()
    rows = [{"env_step": 2, "a": 1}, {"env_step": 1, "a": 5}, {"env_step": 2, "a": 3, "b": None}]
    (run.path / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    table = run.metrics()
    assert table[["env_step", "a"]].to_numpy().tolist() == [[1, 5], [2, 3]]
    assert table["b"].isna().all()


def test_the_buffer_ends_where_a_segment_is_missing_or_damaged(record):
    run = record()
    folder = run.path / "buffer"
    with np.load(folder / "000000000.npz") as file:
        arrays = dict(file)
    for first, rows in ((0, slice(400)), (400, slice(400, 700)), (700, slice(700, None))):
        part = {name: array[rows] for name, array in arrays.items()}
        np.savez(folder / f"{first:09d}.npz", **part)
    assert len(run.buffer()[0]) == STEPS
    (folder / "000000400.npz").unlink()
    assert len(run.buffer()[0]) == 400
    assert "rows 400 to 700 are missing" in problem(run)
    run = RunReader(run.path)
    cut(folder / "000000000.npz")
    rows, version = run.buffer()
    assert (len(rows), len(version)) == (0, 0)
    assert problem(run).startswith("buffer/000000000.npz")


def test_a_damaged_status_is_unknown(record):
    run = record()
    for text in ("", '{"state": "running", "heartbeat": "now"}'):
        (run.path / "status.json").write_text(text)
        damaged = RunReader(run.path)
        assert (damaged.status.state, damaged.status.alive) == ("unknown", False)
        assert problem(damaged).startswith("status.json")


def test_the_version_of_a_part_changes_with_its_files_alone(record):
    run = record()
    parts: dict[tuple, str] = {
        ("facts",): "labels.json",
        ("metrics",): "metrics.jsonl",
        ("profiles",): "weights/profiles.jsonl",
        ("notices",): "notices.jsonl",
        ("snapshot", 400): "weights/snapshot-000000400.parquet",
        ("episodes", 500): "episodes/000000500.npz",
        ("policies", 500): "policies/000000500.npz",
        ("buffer",): "buffer/000000000.npz",
        ("model",): "checkpoint/000000500/state.pt",
        ("scene",): "scene.npz",
        ("recordings",): "run.rrd",
    }
    watched = [("metrics",), ("profiles",), ("notices",), ("buffer",), ("model",)]
    for part, file in parts.items():
        before = {one: run.version(*one) for one in {*watched, part}}
        path = run.path / file
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("ab") as changed:
            changed.write(b"more")
        assert {one for one in before if run.version(*one) != before[one]} == {part}


def test_recordings_are_in_the_order_they_were_written(record):
    run = record()
    for name in ("run-10.rrd", "run.rrd", "run-2.rrd", "run-x.rrd"):
        (run.path / name).touch()
    assert [path.name for path in run.rrd_files()] == ["run.rrd", "run-2.rrd", "run-10.rrd"]


@pytest.mark.slow
def test_tables_are_read_without_a_thread_that_outlives_it(record):
    """One of Arrow's that is alive at its end may abort a process that has done everything."""
    run = record()
    wide = {f"m{i}": 0.5 for i in range(200)}
    rows = [json.dumps({"env_step": step, **wide}) for step in range(2000)]
    (run.path / "metrics.parquet").rename(run.path / "kept.parquet")
    (run.path / "metrics.jsonl").write_text("\n".join(rows) + "\n")
    code = f"""
import os
from pathlib import Path
from tom.record import RunReader
threads = lambda: len(os.listdir("/proc/self/task"))
run = RunReader(Path({str(run.path)!r}))
before = threads()
assert len(run.metrics()) == 2000
assert threads() == before, "rows"
(run.path / "kept.parquet").rename(run.path / "metrics.parquet")
os.utime(run.path / "metrics.parquet")
assert 0 < len(run.metrics()) < 2000
assert len(run.snapshot(400)) == 400
assert threads() == before, "tables"
"""
    subprocess.run([sys.executable, "-c", code], check=True)
