"""The lock of a run folder: one writer; a look at it disturbs nobody."""

import fcntl
from pathlib import Path
from threading import Timer

from tom.record import lock


def test_who_only_looks_is_waited_for(tmp_path: Path):
    lock.acquire(tmp_path).close()
    with (tmp_path / ".writer").open() as look:
        fcntl.flock(look, fcntl.LOCK_SH)
        timer = Timer(0.1, look.close)
        timer.start()
        lock.acquire(tmp_path).close()
        timer.join()
