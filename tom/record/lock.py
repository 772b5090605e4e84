"""One writer for a run folder: a lock that is released when its process ends.

The lock file has the boot id of the machine that wrote last, and the id of the writer. A lock of
another machine may be invisible here, so the heartbeat decides who may write; a writer that was
taken for dead sees another writer's id in the file and stops writing.
"""

import fcntl
import os
import secrets
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path

from tom.errors import TryLaterError, UserError
from tom.record import layout
from tom.record.reader import RunReader
from tom.record.status import BEAT_S

TRIES, WAIT_S = 20, 0.01
"""attempts to lock a run, and seconds between them: `is_held` has the lock for an instant"""


class LostError(OSError):
    """Another writer has taken over the run folder."""


@dataclass
class RunLock:
    """A writer's lock on the run folder `path`, until it is closed or taken over."""

    path: Path
    writer: bytes
    """the content of the lock file as long as no other writer has taken over"""
    _file: int

    def check(self) -> None:
        """Raises LostError if the folder was taken over or is gone; nothing may be written then."""
        try:
            writer = (self.path / layout.LOCK).read_bytes()
        except OSError:
            writer = b""
        if writer != self.writer:
            raise LostError(
                f"run '{self.path.name}' was taken over by another writer, or its folder is gone"
            )

    def close(self) -> None:
        if self._file >= 0:
            os.close(self._file)
            self._file = -1


def acquire(path: Path) -> RunLock:
    """Lock the run folder `path` until the returned lock is closed.

    Raises TryLaterError if another process holds the lock, or another machine writes the run, as a
    new heartbeat shows; if this machine wrote last, the lock is proof enough. Raises UserError if
    the folder cannot be written.
    """
    before = RunReader(path).status  # running, alive or not: its machine's clock may be another
    if before.state == "running" and was_written_here(path) is False:
        time.sleep(2.5 * BEAT_S)
        if RunReader(path).status.heartbeat != before.heartbeat:
            raise TryLaterError(
                f"run '{path.name}' is being written on another machine: stop it there"
            )
    try:
        file = os.open(path / layout.LOCK, os.O_RDWR | os.O_CREAT, 0o644)
    except OSError as error:
        raise UserError(
            f"cannot write into run '{path.name}' ({error.strerror}): make its folder writable"
        ) from error
    for _ in range(TRIES):
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            break
        except OSError:
            time.sleep(WAIT_S)
    else:
        os.close(file)
        raise TryLaterError(
            f"run '{path.name}' is being written by another process: wait for it, or stop it"
        )
    writer = _boot() + secrets.token_hex(8).encode()
    with suppress(OSError):  # a full disk; the lock holds anyway
        os.pwrite(file, writer, 0)
        os.ftruncate(file, len(writer))
    return RunLock(path, os.pread(file, 4096, 0), file)


def is_held(path: Path) -> bool:
    """Whether a process on this machine holds the lock of the run folder `path`."""
    try:
        file = os.open(path / layout.LOCK, os.O_RDONLY)
    except OSError:
        return False
    try:
        fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except OSError:
        return True
    finally:
        os.close(file)
    return False


def is_open_by(pid: int, path: Path) -> bool:
    """Whether process `pid` of this machine writes the run folder `path` (has its lock file open).

    Raises OSError if there is no such process, or it belongs to another user.
    """
    own = (path / layout.LOCK).stat()
    for link in Path(f"/proc/{pid}/fd").iterdir():
        with suppress(OSError):  # closed meanwhile
            if os.path.samestat(link.stat(), own):
                return True
    return False


@contextmanager
def exclusive_lock(folder: Path) -> Iterator[None]:
    """A lock on `folder` among the processes of this machine, held inside the block.

    It is independent of the writers' lock. Raises OSError if there is no such folder.
    """
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX)
        yield
    finally:
        os.close(handle)


def was_written_here(path: Path) -> bool | None:
    """Whether the last writer was this machine since its boot; None if unknown."""
    try:
        return (path / layout.LOCK).read_bytes().startswith(_boot())
    except OSError:
        return None


def _boot() -> bytes:
    """The boot id of this machine, which does not identify it."""
    try:
        return Path("/proc/sys/kernel/random/boot_id").read_bytes()
    except OSError:
        return b""
