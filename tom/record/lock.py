"""One writer for a run folder: a lock that ends with the process that holds it.

The lock file names the boot of the machine that wrote last. On another machine, whose lock may
not be seen here, the heartbeat decides.
"""

import fcntl
import os
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

from tom.errors import UserError
from tom.record import layout


def hold(path: Path) -> int:
    """Lock the run folder `path`; the lock lasts until the returned file is closed.

    Raises UserError when another process holds it, or when the folder cannot be written.
    """
    try:
        lock = os.open(path / layout.LOCK, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o644)
    except OSError as error:
        raise UserError(f"cannot write into run '{path.name}': {error.strerror}") from error
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        os.close(lock)
        raise UserError(f"run '{path.name}' is being written by another process") from error
    with suppress(OSError):  # a full disk: the lock holds all the same
        os.ftruncate(lock, 0)
        os.pwrite(lock, _boot(), 0)
    return lock


def held(path: Path) -> bool:
    """A process on this machine holds the run folder `path`."""
    try:
        lock = os.open(path / layout.LOCK, os.O_RDONLY | os.O_NOFOLLOW)
    except OSError:
        return False
    try:
        fcntl.flock(lock, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError:
        return True
    finally:
        os.close(lock)
    return False


def refuse_if_elsewhere(path: Path, heartbeat: Callable[[], float], patience_s: float) -> None:
    """Raises UserError where another machine is writing the run: its heart beats within patience.

    Returns at once where this machine wrote last: the lock itself is proof then.
    """
    try:
        elsewhere = (path / layout.LOCK).read_bytes() != _boot()
    except OSError:
        return
    if not elsewhere:
        return
    before = heartbeat()
    time.sleep(patience_s)
    if heartbeat() != before:
        raise UserError(f"run '{path.name}' is being written on another machine: stop it there")


def _boot() -> bytes:
    """What this machine is called until it starts again; nothing that names it."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_bytes()
    except OSError:
        return b""
