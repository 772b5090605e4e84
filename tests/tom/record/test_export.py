"""Exports of a run that was recorded for real, read back as other tools read them."""

import json
import resource
import struct
import subprocess
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from recorded import STEPS
from tensorboardX.proto import event_pb2

from tom.errors import UserError
from tom.record import RunReader, Store, manage
from tom.record.export import export, export_small
from tom.record.files import size_of
from tom.record.rerun import viewer
from tom.record.thin import coarse

Event = vars(event_pb2)["Event"]


def tensorboard_scalars(folder: Path) -> list[tuple[str, int, float]]:
    """(name, step, value) of every scalar: records of length, checksum, content, checksum."""
    (file,) = folder.iterdir()
    content, found, at = file.read_bytes(), [], 0
    while at < len(content):
        (length,) = struct.unpack_from("<Q", content, at)
        event = Event.FromString(content[at + 12 : at + 12 + length])
        found += [(v.tag, event.step, v.simple_value) for v in event.summary.value]
        at += 16 + length
    return found


def test_tables(record, tmp_path: Path):
    run = record()
    table = run.metrics()
    csv = pd.read_csv(export(run, "csv", tmp_path))
    pd.testing.assert_frame_equal(csv, table, rtol=1e-12)
    pd.testing.assert_frame_equal(pd.read_parquet(export(run, "parquet", tmp_path)), table)


def test_json_holds_everything_but_arrays(store: Store, record, tmp_path: Path):
    run = record()
    manage.label(store, "run", note="kept")
    content = json.loads(export(run, "json", tmp_path).read_text())
    assert content["description"] == run.config
    assert content["labels"]["note"] == "kept"
    assert [row["env_step"] for row in content["metrics"]] == list(range(100, STEPS + 1, 100))
    assert np.array(content["profiles"]["bins"]).shape == run.profiles().bins.shape
    assert content["notices"] == run.notices()


def test_tensorboard_events_hold_every_number(record, tmp_path: Path):
    run = record()
    scalars = tensorboard_scalars(export(run, "tensorboard", tmp_path))
    table = run.metrics().set_index("env_step")
    assert len(scalars) == int(table.notna().sum().sum())
    for name, step, value in scalars:
        assert value == pytest.approx(table.loc[step, name], rel=1e-6)


def _export_within(run: RunReader, kind: str, folder: Path, size: int) -> None:
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, resource.RLIM_INFINITY))
    with pytest.raises(OSError):  # noqa: PT011 - of any kind
        export(run, kind, folder)


@pytest.mark.fault
@pytest.mark.parametrize(("kind", "share"), [("csv", 0.5), ("tensorboard", 0.5), ("rrd", 0.99)])
def test_a_disk_that_is_full_during_an_export__is_named_and_nothing_is_left(
    record, tmp_path: Path, kind: str, share: float
):
    run = record()
    whole = export(run, kind, tmp_path)
    size = int(share * (whole.stat().st_size if whole.is_file() else size_of(whole)))
    out = tmp_path / "out"
    # In a process of its own: Rerun's threads survive no fork, and one may hang.
    child = get_context("spawn").Process(target=_export_within, args=(run, kind, out, size))
    child.start()
    child.join(60)
    alive = child.is_alive()
    child.kill()
    child.join()
    assert not alive
    assert child.exitcode == 0
    assert list(out.iterdir()) == []


def test_a_recording_is_made_from_the_files(record, tmp_path: Path):
    run = record()
    assert run.rrd_files() == []
    path = export(run, "rrd", tmp_path)
    assert path.read_bytes()[:4] == b"RRF2"
    verify = [viewer.binary(), "rrd", "verify", path]  # it also misses an end that was cut off
    subprocess.run(verify, env=viewer.without_analytics(tmp_path), check=True, capture_output=True)


def test_a_small_copy_reads_like_the_run(store: Store, record, tmp_path: Path):
    run = record()
    manage.label(store, "run", name="shown")
    small = RunReader(export_small(run, tmp_path))
    assert small.is_run
    assert small.problems == []
    assert small.labels.name == "shown"
    assert small.status == run.status
    assert small.config["config"] == run.config["config"]
    known = run.metrics().dropna(axis=1, how="all")
    pd.testing.assert_frame_equal(small.metrics(), known, rtol=1e-4)
    np.testing.assert_allclose(small.profiles().bins, run.profiles().bins, rtol=1e-4)
    steps = small.snapshot_steps()
    assert steps[-1] == run.snapshot_steps()[-1]
    np.testing.assert_allclose(
        small.snapshot(steps[-1])["weight"], run.snapshot(steps[-1])["weight"], rtol=1e-3
    )
    for name in ("obs", "action", "reward", "next_obs", "terminated"):
        kept, whole = (getattr(one.buffer()[0], name) for one in (small, run))
        np.testing.assert_allclose(kept, whole, rtol=1e-3)
    np.testing.assert_array_equal(small.buffer()[1], run.buffer()[1])
    (episode,) = small.episodes(STEPS)
    np.testing.assert_allclose(episode.obs, run.episodes(STEPS)[0].obs, rtol=1e-3)
    assert episode.info == run.episodes(STEPS)[0].info


def test_coarse_numbers_are_close_and_special_ones_stay():
    numbers = np.random.default_rng(0).normal(size=1000) * 10.0 ** np.arange(-10, 10).repeat(50)
    np.testing.assert_allclose(coarse(numbers), numbers, rtol=2**-11)
    special = np.array([0.0, -0.0, np.inf, -np.inf, np.nan, 1.0])
    np.testing.assert_array_equal(coarse(special), special.astype(np.float32))
    assert coarse(np.array([True])).dtype == bool
    assert coarse(np.array(1.5)).shape == ()


def test_an_export_is_never_written_over(record, tmp_path: Path):
    run = record()
    for write in (lambda: export(run, "csv", tmp_path), lambda: export_small(run, tmp_path)):
        write()
        before = sorted(tmp_path.iterdir())
        with pytest.raises(UserError, match="exists already"):
            write()
        assert sorted(tmp_path.iterdir()) == before
