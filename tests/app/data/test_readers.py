"""The cached readers: what is on the disk now, a damaged run beside the others."""

import gc
import json
import os
import shutil
import time
import weakref
from pathlib import Path

import numpy as np
import pytest
from studio_runs import PENDULUM_TOM, info, set_status

from app.data import buffer, cache, readers
from tom.analysis.curves import curve_points
from tom.record import lock
from tom.record.reader import RunReader


@pytest.fixture
def own(store: Path, tmp_path: Path) -> Path:
    """A copy of one run that a test may damage."""
    shutil.copytree(store / PENDULUM_TOM, tmp_path / PENDULUM_TOM)
    return tmp_path


def test_a_listing_reads_no_run_again_however_little_is_cached(
    store: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cache, "RESULTS", type(cache.RESULTS)(1))
    first, second = readers.listing(str(store)), readers.listing(str(store))
    assert all(a is b for a, b in zip(first.runs, second.runs, strict=True))


def test_tables_are_the_readers(store: Path) -> None:
    run, reader = info(store, PENDULUM_TOM), RunReader(store / PENDULUM_TOM)
    assert readers.metrics(run).equals(reader.metrics())
    assert readers.profiles(run).bins.tolist() == reader.profiles().bins.tolist()
    assert readers.recordings(run) == ["run.rrd"]
    assert readers.problems(run) == []


def test_a_new_status_is_seen(own: Path) -> None:
    set_status(own / PENDULUM_TOM, state="running", heartbeat=time.time())
    writer = lock.acquire(own / PENDULUM_TOM)
    assert info(own, PENDULUM_TOM).status.alive
    writer.close()
    run = info(own, PENDULUM_TOM)
    assert (run.status.shown, "ended" in run.status.reason) == ("dead", True)
    (own / PENDULUM_TOM / ".writer").unlink()  # as on another machine: its beat decides
    assert info(own, PENDULUM_TOM).status.alive
    set_status(own / PENDULUM_TOM, heartbeat=time.time() - 31)
    assert info(own, PENDULUM_TOM).status.shown == "dead"


def test_a_damaged_run_is_named_and_the_others_stay(own: Path) -> None:
    shutil.copytree(own / PENDULUM_TOM, own / "damaged")
    (own / "damaged" / "status.json").write_text("{")
    with (own / "damaged" / "metrics.jsonl").open("a") as file:
        file.write('{"env_step": 12')
    (own / "damaged" / "metrics.parquet").unlink()
    (own / "notes").mkdir()
    found = readers.listing(str(own))
    assert {run.run_id for run in found.runs} == {PENDULUM_TOM, "damaged"}
    assert any("notes" in problem for problem in found.problems)
    words = " ".join(readers.problems(info(own, "damaged")))
    assert "status.json" in words
    assert "metrics.jsonl" in words
    assert readers.problems(info(own, PENDULUM_TOM)) == []


def test_points_are_what_a_curve_would_have(store: Path) -> None:
    run = info(store, PENDULUM_TOM)
    frame = readers.metrics(run)
    points = readers.metric_counts(run)
    assert points == {name: len(curve_points(frame, name)[0]) for name in points}
    assert set(frame) - set(points) == {n for n in frame if not np.isfinite(frame[n]).any()}


def test_of_a_run_in_training_one_version_is_held(own: Path) -> None:
    path = own / PENDULUM_TOM
    (path / "metrics.parquet").unlink()
    segment = max((path / "buffer").glob("*.npz"), key=lambda file: int(file.stem))
    held: list[weakref.ref] = []
    for beat in range(3):
        with (path / "metrics.jsonl").open("a") as file:
            file.write(json.dumps({"env_step": 99_999 + beat, "eval/return": 7.5}) + "\n")
        for changed in (segment, path / "weights/profiles.jsonl"):
            os.utime(changed, (beat, beat))
        held += read(info(own, PENDULUM_TOM))
    gc.collect()
    assert [ref() is not None for ref in held] == [False] * 8 + [True] * 4


def read(run: RunReader) -> list[weakref.ref]:
    parts = readers.metrics(run), readers.profiles(run), buffer.recorded(run).rows.obs
    parts = *parts, buffer.row_episodes(run)[2]
    return [weakref.ref(part) for part in parts]
