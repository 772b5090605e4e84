"""The place where a sweep stores its runs: a folder, or a bucket (`bucket_backend`)."""

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal, Protocol

from tom.record import RunReader, Store, lock
from tom.record.status import DEAD_AFTER_S


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

    def writer(self, run: RunReader) -> Literal["here", "away"] | None:
        """Whether a process of this machine, or perhaps of another one, is writing the run."""
        ...

    def ended(self, run_id: str) -> None:
        """Note that the process which `words` last started for the run was seen to end.

        Raises OSError if the runs cannot be reached.
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

    def writer(self, run: RunReader) -> Literal["here", "away"] | None:
        """By the lock, or by another machine's heartbeat that was seen to change of late."""
        here = lock.written_here(run.path)
        if lock.held(run.path):  # a shared file system may show another machine's lock, too
            return "away" if here is False else "here"
        status = run.status
        self._lease.see(run.run_id, status if status.state == "running" and here is False else None)
        return "away" if self._lease.holds(run.run_id) else None

    def ended(self, run_id: str) -> None:
        """Do nothing: the lock, or on another machine the heartbeat, says so as well."""

    def keep_log(self, log: Path) -> str:
        return str(log)


class Lease:
    """How long a run that another machine writes is left to it, by this machine's own clock.

    Two machines' clocks may differ by any amount, so a heartbeat's time says nothing here: what
    counts is when this machine saw it change.
    """

    def __init__(self, lasts_s: float, clock: Callable[[], float] = time.monotonic) -> None:
        """A run is left to its writer until it was seen unchanged for `lasts_s` by `clock` (s)."""
        self._lasts_s = lasts_s
        self._clock = clock
        self._seen: dict[str, tuple[object, float]] = {}

    def see(self, run_id: str, sign: object) -> None:
        """Note what changes while the run is written; None: nobody claims to write it."""
        if run_id not in self._seen or self._seen[run_id][0] != sign:
            self._seen[run_id] = (sign, self._clock())

    def holds(self, run_id: str) -> bool:
        """Whether the run is to be left to its writer."""
        sign, since = self._seen.get(run_id, (None, 0.0))
        return sign is not None and self._clock() - since < self._lasts_s

    def forget(self) -> None:
        """Count all runs anew, because none of them could be seen for a while."""
        self._seen.clear()
