"""The runs of a sweep in an object store, as far as its driver needs them."""

import secrets
import shutil
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Literal

from tom.record import RunReader, Store, checkpoint, layout
from tom.record.bucket import attempts
from tom.record.bucket.objects import Bucket
from tom.sweep.backend import Lease
from tom.training.plan import Trial

LOOK_S = 5.0  # between two updates of a run

LEASE_S = 600.0
"""seconds without a change after which a running run counts as nobody's

A live one is put every 10 s, but its status after all else: a run of Humanoid that goes on puts two
checkpoints of 200 MB first, which is ten minutes at 6 Mbit/s. Its end is tried for as long.
"""


class BucketBackend(AbstractContextManager["BucketBackend", None]):
    """The runs of `trials` in `bucket`.

    `store` is a temporary folder of this machine. For every run it holds the settings, the status
    and the names of the checkpoints.
    """

    def __init__(
        self,
        bucket: Bucket,
        trials: Sequence[Trial],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """`clock` gives seconds that never decrease.

        Raises OSError if the bucket does not answer.
        """
        self._bucket = bucket
        self._folder = Path(tempfile.mkdtemp(prefix="tom-sweep-"))
        self._clock = clock
        self._next: dict[str, float] = {}
        self._lease = Lease(LEASE_S, clock)
        self._own = secrets.token_hex(attempts.OWN_BYTES)  # the attempts of this driver end with it
        self.store = Store(self._folder)
        try:
            for trial in trials:
                self.look(trial.run_id, now=True)
        except BaseException:
            self.__exit__()
            raise

    def __exit__(self, *_: object) -> None:
        shutil.rmtree(self._folder, ignore_errors=True)

    def look(self, run_id: str, *, now: bool = False) -> None:
        if not now and self._clock() < self._next.get(run_id, 0.0):
            return
        self._next[run_id] = self._clock() + LOOK_S
        try:
            names = self._bucket.names(run_id)
            attempt = attempts.newest(names)
            if attempt is not None:
                self._show(f"{run_id}/{attempt}/", names, self._folder / run_id)
        except OSError:
            self._lease.forget()  # whoever writes runs may not have reached the store either
            raise
        self._lease.see(run_id, self._sign(run_id, attempts.claimed(names), attempt))

    def words(self, run_id: str, words: Sequence[str]) -> list[str]:
        return ["tom.sweep.worker", self._bucket.url, self._own, run_id, *words]

    def writer(self, run: RunReader) -> Literal["away"] | None:
        """Another machine's, if it is claimed, says that it is running, and changed of late.

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

    def _show(self, attempt: str, names: Sequence[str], path: Path) -> None:
        """Copy settings, status and names of checkpoints of an attempt into the folder `path`."""
        path.mkdir(exist_ok=True)
        for name in (layout.CONFIG, layout.STATUS):
            (path / name).write_bytes(self._bucket.read(attempt + name))
        held = path / checkpoint.FOLDER
        shutil.rmtree(held, ignore_errors=True)
        start = f"{attempt}{checkpoint.FOLDER}/"
        for name in names:
            if name.startswith(start) and name.endswith(f"/{checkpoint.MANIFEST}"):
                (held / name.removeprefix(start)).parent.mkdir(parents=True)
