"""The folder of a run on this machine until its object store has all of it.

Its name follows from the store and the run, so that the same command finds it again if the store
did not accept all of it.
"""

import fcntl
import hashlib
import os
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from tom.record import lock

WAIT_S = 60.0  # a training whose worker was killed writes its checkpoint within this time


@contextmanager
def place(url: str, run_id: str) -> Iterator[Path]:
    """A local run store for `run_id` on its way to `url`: always the same folder, with its content.

    It is removed at the end if it is empty. If another process of this machine uses it, a new one
    is made. Raises OSError if that is not possible.
    """
    path, handle = _held(url, run_id)
    try:
        yield path
    finally:
        with suppress(OSError):
            path.rmdir()  # fails if it holds a run, which must stay
        if handle is not None:
            os.close(handle)


def _held(url: str, run_id: str) -> tuple[Path, int | None]:
    """The folder, and the open handle that locks it for this process."""
    path = _root() / f"{hashlib.sha256(url.encode()).hexdigest()[:12]}-{run_id}"
    path.mkdir(exist_ok=True)
    handle = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW)
    if _locked(path, handle) and _ended(path / run_id):
        return path, handle
    os.close(handle)
    return _new(), None


def _locked(path: Path, handle: int) -> bool:
    """Lock the open folder; False if another process has it, or has just removed it."""
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        return os.path.samestat(os.fstat(handle), path.stat())
    except (BlockingIOError, FileNotFoundError):
        return False


def _ended(run: Path) -> bool:
    """Whether nobody writes the run any more; waits for a training whose worker was just killed."""
    until = time.monotonic() + WAIT_S
    while lock.held(run):
        if time.monotonic() > until:
            return False
        time.sleep(0.1)
    return True


def _root() -> Path:
    """The user's own temporary folder; a new one if somebody else has made one of that name."""
    path = Path(tempfile.gettempdir(), f"tom-runs-{os.getuid()}")
    with suppress(FileExistsError):
        path.mkdir(mode=0o700)
    status = path.lstat()
    own = status.st_uid == os.getuid() and not status.st_mode & 0o022
    return path if own and path.is_dir() and not path.is_symlink() else _new()


def _new() -> Path:
    return Path(tempfile.mkdtemp(prefix="tom-"))
