"""Where a sweep's runs lie, as its driver sees it: a folder, or a bucket (`bucket_backend`)."""

from collections.abc import Sequence
from pathlib import Path
from typing import Protocol

from tom.record import RunReader, Store, lock, manage

LOGS = ".sweep"


class Backend(Protocol):
    """The runs of a sweep. `store` holds them, or as much of each as a driver has to know."""

    store: Store

    def look(self, run_id: str, *, now: bool = False) -> None:
        """Bring what `store` holds of a run up to date; at once, or where it is due.

        Raises OSError where the runs cannot be reached.
        """
        ...

    def words(self, run_id: str, words: Sequence[str]) -> list[str]:
        """What follows `python -m` for a training that `tom train` would begin with `words`."""
        ...

    def written(self, run: RunReader) -> bool:
        """Some process is writing the run."""
        ...

    def begin_anew(self, run_id: str) -> str:
        """Make room for a run that begins once more; says where what was there lies now."""
        ...

    def keep_log(self, log: Path) -> str:
        """Where the log of a failed training is found when the sweep is over."""
        ...


class FolderBackend:
    """A run store on a disk that everybody who trains can write."""

    def __init__(self, store: Store) -> None:
        self.store = store

    def look(self, run_id: str, *, now: bool = False) -> None:
        """The folder itself is read: it is never out of date."""

    def words(self, run_id: str, words: Sequence[str]) -> list[str]:
        return ["tom", "train", *words, "--no-rerun", f"--store={self.store.path.resolve()}"]

    def written(self, run: RunReader) -> bool:
        """The lock is proof on this machine; another's is judged by its heartbeat."""
        if not run.path.is_dir():
            return False
        return lock.held(run.path) or (lock.written_here(run.path) is False and run.status.alive)

    def begin_anew(self, run_id: str) -> str:
        return str(manage.trash(self.store, run_id))

    def keep_log(self, log: Path) -> str:
        return str(log)
