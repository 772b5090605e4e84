"""The place where a sweep stores its runs: a folder, or a bucket of an object store."""

import secrets
import shutil
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Literal

from tom.errors import UserError
from tom.record import RunReader, Store, checkpoint, layout, lock
from tom.record.bucket import attempts
from tom.record.bucket.objects import Bucket
from tom.record.status import DEAD_AFTER_S
from tom.training.plan import Trial

Clock = Callable[[], float]
"""gives seconds that never decrease"""

LOOK_S = 5.0  # between two updates of a bucket's run
LEASE_S = 600.0
"""seconds without a change after which a running run in a bucket counts as nobody's

A live one is put every 10 s, but its status after all else: a run of Humanoid that goes on puts two
checkpoints of 200 MB first, which is ten minutes at 6 Mbit/s. Its end is tried for as long.
"""


class Lease:
    """How long a run that another machine writes is left to it, by this machine's own clock.

    Two machines' clocks may differ by any amount, so a heartbeat's time says nothing here: what
    counts is when this machine saw it change.
    """

    def __init__(self, lasts_s: float, clock: Clock = time.monotonic) -> None:
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


class FolderBackend:
    """The runs of a sweep in a folder that all trainings can write to: `store`.

    Of a bucket, `store` holds the parts of them that a driver needs. Every method raises OSError if
    the runs cannot be reached.
    """

    def __init__(self, store: Store, clock: Clock = time.monotonic) -> None:
        self.store = store
        self._lease = Lease(DEAD_AFTER_S, clock)

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
        self._lease.see(run.run_id, status if status.state == "running" and here is False else None)
        return "away" if self._lease.holds(run.run_id) else None

    def ended(self, run_id: str) -> None:
        """Note that the process that was last started for the run was seen to end.

        In a folder the lock shows it, or on another machine the heartbeat.
        """

    def keep_log(self, log: Path) -> str:
        """Keep the log of a failed training; returns its place after the end of the sweep."""
        return str(log)


class BucketBackend(FolderBackend, AbstractContextManager["BucketBackend", None]):
    """The runs of `trials` in `bucket`.

    `store` is a temporary folder of this machine. For every run it holds the settings, the status
    and the names of the checkpoints.
    """

    def __init__(
        self, bucket: Bucket, trials: Sequence[Trial], clock: Clock = time.monotonic
    ) -> None:
        """Raises OSError if the bucket does not answer."""
        self._folder = Path(tempfile.mkdtemp(prefix="tom-sweep-"))
        super().__init__(Store(self._folder))
        self._bucket, self._clock = bucket, clock
        self._next: dict[str, float] = {}
        self._lease = Lease(LEASE_S, clock)
        self._own = secrets.token_hex(attempts.OWN_BYTES)  # the attempts of this driver end with it
        try:
            for trial in trials:
                self.update(trial.run_id, now=True)
        except BaseException:
            self.__exit__()
            raise

    def __exit__(self, *_: object) -> None:
        shutil.rmtree(self._folder, ignore_errors=True)

    def update(self, run_id: str, *, now: bool = False) -> None:
        if not now and self._clock() < self._next.get(run_id, 0.0):
            return
        self._next[run_id] = self._clock() + LOOK_S
        try:
            names = self._bucket.names(run_id)
            attempt = attempts.newest(names)
            if attempt is not None:
                self._copy(f"{run_id}/{attempt}/", names, self._folder / run_id)
        except OSError:
            self._lease.forget()  # whoever writes runs may not have reached the store either
            raise
        self._lease.see(run_id, self._sign(run_id, attempts.claimed(names), attempt))

    def command(self, run_id: str, options: Sequence[str]) -> list[str]:
        return ["tom.sweep.worker", self._bucket.url, self._own, run_id, *options]

    def writer(self, run: RunReader) -> Literal["away"] | None:
        """Another machine, if the run is claimed, says that it is running, and changed recently.

        A claim that is not the run yet counts as running: its worker may be fetching or putting.
        If this is wrong, the old attempt ends when it sees the newer one.
        """
        return "away" if self._lease.holds(run.run_id) else None

    def ended(self, run_id: str) -> None:
        """Take back its claim, so that neither this machine nor another one waits for it.

        A worker on a machine that was lost may still train: it ends when it sees a newer attempt.
        """
        attempts.release(self._bucket, run_id, self._own)

    def keep_log(self, log: Path) -> str:
        name = f"{layout.LOGS}/{log.name}"
        try:
            self._bucket.write(name, log.read_bytes())
        except OSError as error:
            return f"none ({error})"
        return f"{self._bucket.url}/{name}"

    def _sign(self, run_id: str, claimed: str | None, attempt: str | None) -> object:
        """What changes while somebody writes the run; None if nobody does.

        `claimed` is the newest attempt that somebody began, `attempt` the one that is the run.
        """
        status = RunReader(self._folder / run_id).status
        begins = claimed is not None and (attempt is None or claimed > attempt)
        runs = claimed is not None and claimed == attempt and status.state == "running"
        return (claimed, status) if begins or runs else None

    def _copy(self, attempt: str, names: Sequence[str], path: Path) -> None:
        """Copy settings, status and names of checkpoints of an attempt into the folder `path`."""
        path.mkdir(exist_ok=True)
        for name in (layout.CONFIG, layout.STATUS):
            (path / name).write_bytes(self._bucket.read(attempt + name))
        checkpoints = path / checkpoint.FOLDER
        shutil.rmtree(checkpoints, ignore_errors=True)
        start = f"{attempt}{checkpoint.FOLDER}/"
        for name in names:
            if name.startswith(start) and name.endswith(f"/{checkpoint.MANIFEST}"):
                (checkpoints / name.removeprefix(start)).parent.mkdir(parents=True)


def open_backend(
    store: Path | str, trials: Sequence[Trial]
) -> AbstractContextManager[FolderBackend]:
    """The storage of the runs: a folder or s3://BUCKET/PREFIX.

    Raises UserError if an object store cannot be reached.
    """
    if isinstance(store, Path):
        return nullcontext(FolderBackend(Store(store)))
    try:
        return BucketBackend(Bucket.open(store), trials)
    except OSError as error:
        raise UserError(f"{store}: {error}") from error
