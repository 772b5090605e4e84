"""The lock of a run folder: one writer; a look at it disturbs nobody."""

import fcntl
from pathlib import Path
from threading import Timer

import pytest

from tom.errors import UserError
from tom.record import lock


def test_a_second_writer_is_refused_until_the_first_has_ended(tmp_path: Path):
    first = lock.acquire(tmp_path)
    with pytest.raises(UserError, match="being written by another process"):
        lock.acquire(tmp_path)
    assert lock.held(tmp_path)
    first.close()
    assert not lock.held(tmp_path)
    lock.acquire(tmp_path).close()


def test_who_only_looks_is_waited_for(tmp_path: Path):
    lock.acquire(tmp_path).close()
    with (tmp_path / ".writer").open() as look:
        fcntl.flock(look, fcntl.LOCK_SH)
        timer = Timer(0.1, look.close)
        timer.start()
        lock.acquire(tmp_path).close()
        timer.join()
