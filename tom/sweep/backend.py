"""The place where a sweep stores its runs: a folder, or a bucket (`bucket_backend`)."""

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Protocol

from tom.errors import UserError
from tom.record import RunReader, Store, lock, manage
from tom.record.lock import BusyError
from tom.record.status import DEAD_AFTER_S
from tom.sweep.lease import Lease


class Backend(Protocol):
    """The runs of a sweep. `store` holds them, or the parts of them that a driver needs."""

    store: Store

    def look(self, run_id: str, *, now: bool = False) -> None:
        """Update the parts of a run in `store`: at once if `now`, else when an update is due.

        Raises OSError if the runs cannot be reached.
        """
        ...

    def words(self, run_id: str, words: Sequence[str]) -> list[str]:
        """The words after `python -m` that start the training `tom train WORDS`."""
        ...

    def written(self, run: RunReader) -> bool:
        """Whether a process is writing the run."""
        ...

    def ended(self, run_id: str) -> None:
        """Note that the process which `words` last started for the run was seen to end.

        Raises OSError if the runs cannot be reached.
        """
        ...

    def written_here(self, run: RunReader) -> bool:
        """Whether a process of this machine is writing the run, as far as that can be told."""
        ...

    def begin_anew(self, run_id: str) -> str:
        """Make room for a run that starts from the beginning; returns where its old files are.

        Raises BusyError if another process has the run just now, UserError if it cannot be moved.
        """
        ...

    def keep_log(self, log: Path) -> str:
        """Keep the log of a failed training; returns its place after the end of the sweep."""
        ...


class FolderBackend:
    """A run store on a disk that all trainings can write to."""

    def __init__(self, store: Store, clock: Callable[[], float] = time.monotonic) -> None:
        """`clock` gives seconds that never decrease."""
        self.store = store
        self._lease = Lease(DEAD_AFTER_S, clock)

    def look(self, run_id: str, *, now: bool = False) -> None:
        """Do nothing: the folder itself is read, so it is never out of date."""

    def words(self, run_id: str, words: Sequence[str]) -> list[str]:
        return ["tom", "train", *words, "--no-rerun", f"--store={self.store.path.resolve()}"]

    def written(self, run: RunReader) -> bool:
        """Whether the lock is held, or another machine's heartbeat was seen to change of late."""
        if lock.held(run.path):
            return True
        status = run.status
        away = status.state == "running" and lock.written_here(run.path) is False
        self._lease.see(run.run_id, status if away else None)
        return self._lease.holds(run.run_id)

    def ended(self, run_id: str) -> None:
        """Do nothing: the lock, or on another machine the heartbeat, says so as well."""

    def written_here(self, run: RunReader) -> bool:
        # A shared file system may show another machine's lock, too.
        return lock.held(run.path) and lock.written_here(run.path) is not False

    def begin_anew(self, run_id: str) -> str:
        try:
            return str(manage.trash(self.store, run_id))
        except UserError as error:
            if (self.store.path / run_id).is_dir():
                raise
            raise BusyError(f"run '{run_id}' was moved away by another process") from error

    def keep_log(self, log: Path) -> str:
        return str(log)
