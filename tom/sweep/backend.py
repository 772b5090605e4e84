"""The place where a sweep stores its runs: a folder, or a bucket (`bucket`) of an object store."""

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal

from tom.record import RunReader, Store, lock
from tom.record.status import DEAD_AFTER_S

Clock = Callable[[], float]
"""gives seconds that never decrease"""


class FolderBackend:
    """The runs of a sweep in a folder that all trainings can write to: `store`.

    Of a bucket, `store` holds the parts of them that a driver needs. Every method raises OSError if
    the runs cannot be reached.

    How long a run that another machine writes is left to it goes by this machine's own `clock`: two
    machines' clocks may differ by any amount, so what counts is when this one saw its status
    change, and that `lease_s` have not passed since.
    """

    lease_s = DEAD_AFTER_S

    def __init__(self, store: Store, clock: Clock = time.monotonic) -> None:
        self.store = store
        self._clock = clock
        self._seen: dict[str, tuple[object, float]] = {}
        """what changes while a run is written (None: nobody claims to write it), and since when"""

    def update(self, run_id: str, *, now: bool = False) -> None:
        """Update the parts of a run in `store`: at once if `now`, else when an update is due.

        The folder itself is read, so it is never out of date.
        """

    def command(self, run_id: str, options: Sequence[str]) -> list[str]:
        """The arguments of `python -m` that start the training `tom train OPTIONS`."""
        return ["tom", "train", *options, "--no-rerun", f"--store={self.store.path.resolve()}"]

    def writer(self, run: RunReader) -> Literal["here", "away"] | None:
        """Whether a process of this machine, or perhaps of another one, is writing the run.

        By the lock, or by another machine's heartbeat that was seen to change a moment ago.
        """
        here = lock.written_here(run.path)
        if lock.held(run.path):  # a shared file system may also show another machine's lock
            return "away" if here is False else "here"
        status = run.status
        self._see(run.run_id, status if status.state == "running" and here is False else None)
        return "away" if self._leased(run.run_id) else None

    def ended(self, run_id: str) -> None:
        """Note that the process that was last started for the run was seen to end.

        In a folder the lock shows it, or on another machine the heartbeat.
        """

    def keep_log(self, log: Path) -> str:
        """Keep the log of a failed training; returns its place after the end of the sweep."""
        return str(log)

    def _see(self, run_id: str, sign: object) -> None:
        if run_id not in self._seen or self._seen[run_id][0] != sign:
            self._seen[run_id] = (sign, self._clock())

    def _leased(self, run_id: str) -> bool:
        """Whether the run is to be left to its writer."""
        sign, since = self._seen.get(run_id, (None, 0.0))
        return sign is not None and self._clock() - since < self.lease_s
