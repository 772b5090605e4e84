"""What a checkpoint counts on outlives a power loss at any later moment."""

import os
from pathlib import Path

import numpy as np
import pytest
from recorded import ACTION, Config, transitions

from tom.events import Collected
from tom.record import Store, layout
from tom.record.reader import RunReader
from tom.record.writer import RunWriter


class Disk:
    """Which content of which file has reached the disk: as it was when it was last synced."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self._held: dict[int, bytes] = {}
        self._sync = os.fsync
        monkeypatch.setattr(os, "fsync", self._synced)

    def _synced(self, handle: int) -> None:
        self._sync(handle)
        path = Path(f"/proc/self/fd/{handle}")
        if path.is_file():
            self._held[path.stat().st_ino] = path.read_bytes()

    def lose_power(self, folder: Path) -> None:
        """Every file of the folder is as it was last synced: one that never was is empty."""
        for path in folder.iterdir():
            path.write_bytes(self._held.get(path.stat().st_ino, b""))


def write(writer: RunWriter, first: int, count: int) -> None:
    writer.rows(Collected(0, transitions(first, count), np.zeros(count, np.int64)))


def test_rows_of_an_earlier_version_are_read_with_those_that_know_their_policy(store: Store):
    writer = RunWriter.create(store, "run", Config)
    behaviour = np.arange(5 * 2 * ACTION, dtype=np.float32).reshape(5, -1)
    write(writer, 0, 10)
    writer.rows(Collected(0, transitions(10, 5), np.ones(5, np.int64), {}, behaviour))
    writer.close()
    found = store.run("run").recorded()
    np.testing.assert_array_equal(found.rows.reward, np.arange(15))
    assert np.isnan(found.behaviour[:10]).all()
    np.testing.assert_array_equal(found.behaviour[10:], behaviour)
    assert not store.run("run").keeps_behaviour()


def held(run: Path) -> list[float]:
    return RunReader(run).buffer()[0].reward.tolist()


def test_rows_that_a_checkpoint_counts_on_outlive_a_power_loss_long_after_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    disk = Disk(monkeypatch)
    writer = RunWriter.create(Store(tmp_path), "a", Config)
    write(writer, 0, 30)
    write(writer, 30, 30)
    mark = writer.mark()
    write(writer, 60, 40)
    writer.close()
    disk.lose_power(writer.path / layout.BUFFER)
    assert held(writer.path)[:60] == list(range(60))
    again = RunWriter(writer.path, Config)
    again.rewind(mark, 0)
    assert held(again.path) == list(range(60))
    write(again, 60, 10)
    again.close()
    assert held(again.path) == list(range(70))
