"""What a checkpoint counts on outlives a power loss at any later moment."""

import fcntl
import os
from pathlib import Path
from threading import Timer

import numpy as np
import pytest
from recorded import Config, transitions

from tom.events import Collected
from tom.record import Store, layout, lock
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
    again.rewind(mark)
    assert held(again.path) == list(range(60))
    write(again, 60, 10)
    again.close()
    assert held(again.path) == list(range(70))


def test_who_only_looks_at_the_lock_is_waited_for(tmp_path: Path):
    lock.acquire(tmp_path).close()
    with (tmp_path / ".writer").open() as look:
        fcntl.flock(look, fcntl.LOCK_SH)
        timer = Timer(0.1, look.close)
        timer.start()
        lock.acquire(tmp_path).close()
        timer.join()
