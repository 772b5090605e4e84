"""One writer for a run folder: a lock that ends with the process that holds it.

The lock file names the boot of the machine that wrote last, and which writer of it that was. On
another machine, whose lock may not be seen here, the heartbeat decides who may write; a writer that
was thought dead finds another one's name in the file and writes no more.
"""

import fcntl
import os
import secrets
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from tom.errors import UserError
from tom.record import layout

LOOKS, LOOK_S = 100, 0.01  # how often, and how long, a look at the lock is waited for


class LostError(OSError):
    """Another writer has taken the run folder over."""


@dataclass
class RunLock:
    """A writer's lock on the run folder `path`, until it is closed or taken over."""

    path: Path
    name: bytes
    _file: int

    @property
    def lost(self) -> bool:
        """Another writer has taken the folder over, or nothing is there any more."""
        try:
            return (self.path / layout.LOCK).read_bytes() != self.name
        except OSError:
            return True

    def check(self) -> None:
        """Raises LostError when the folder was taken over: nothing may be written then."""
        if self.lost:
            raise LostError(f"run '{self.path.name}' was taken over by another writer")

    def close(self) -> None:
        """Release the lock."""
        if self._file >= 0:
            os.close(self._file)
            self._file = -1


def acquire(path: Path) -> RunLock:
    """Lock the run folder `path`; the lock lasts until what is returned is closed.

    Raises UserError when another process holds it, or when the folder cannot be written.
    """
    try:
        lock = os.open(path / layout.LOCK, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o644)
    except OSError as error:
        raise UserError(
            f"cannot write into run '{path.name}' ({error.strerror}): make its folder writable"
        ) from error
    try:
        _lock(lock)
    except OSError as error:
        os.close(lock)
        raise UserError(
            f"run '{path.name}' is being written by another process: wait for it, or stop it"
        ) from error
    name = _boot() + secrets.token_hex(8).encode()
    with suppress(OSError):  # a full disk: the lock holds all the same
        os.pwrite(lock, name, 0)
        os.ftruncate(lock, len(name))
    return RunLock(path, os.pread(lock, 4096, 0), lock)


def _lock(file: int) -> None:
    """Lock `file` for one writer. Raises OSError where another one has it.

    Who only looks (`held`) shares the lock for an instant, which is waited for.
    """
    for _ in range(LOOKS):
        with suppress(OSError):
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return
        fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)  # a writer's lock refuses this as well
        fcntl.flock(file, fcntl.LOCK_UN)
        time.sleep(LOOK_S)
    fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)


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


@contextmanager
def alone_in(folder: Path) -> Iterator[None]:
    """Inside the block is one process of this machine at a time, of those that ask for `folder`.

    Raises OSError where there is no such folder. No writer of a run asks for its folder.
    """
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        os.close(handle)


def written_here(path: Path) -> bool | None:
    """This machine, since it was started, wrote the run folder last; None where nobody knows."""
    try:
        return (path / layout.LOCK).read_bytes().startswith(_boot())
    except OSError:
        return None


def refuse_if_elsewhere(path: Path, heartbeat: Callable[[], float], patience_s: float) -> None:
    """Raises UserError where another machine is writing the run: its heart beats within patience.

    Returns at once where this machine wrote last: the lock itself is proof then.
    """
    if written_here(path) is not False:
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
