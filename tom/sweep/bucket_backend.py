"""The runs of a sweep in an object store, as far as its driver needs them."""

import shutil
import tempfile
import time
from collections.abc import Sequence
from contextlib import AbstractContextManager
from pathlib import Path

from tom.record import RunReader, Store, checkpoint, layout
from tom.record.bucket import attempts
from tom.record.bucket.objects import Bucket
from tom.sweep.backend import LOGS
from tom.training.plan import Trial

LOOK_S = 5.0  # between two updates of a run


class BucketBackend(AbstractContextManager["BucketBackend", None]):
    """The runs of `trials` in `bucket`.

    `store` is a temporary folder of this machine. For every run it holds the settings, the status
    and the names of the checkpoints.
    """

    def __init__(self, bucket: Bucket, trials: Sequence[Trial]) -> None:
        """Raises OSError if the bucket does not answer."""
        self._bucket = bucket
        self._folder = Path(tempfile.mkdtemp(prefix="tom-sweep-"))
        self._next: dict[str, float] = {}
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
        if not now and time.monotonic() < self._next.get(run_id, 0.0):
            return
        self._next[run_id] = time.monotonic() + LOOK_S
        names = self._bucket.names(run_id)
        attempt = attempts.newest(names)
        if attempt is not None:
            self._show(f"{run_id}/{attempt}/", names, self._folder / run_id)

    def words(self, run_id: str, words: Sequence[str]) -> list[str]:
        return ["tom.sweep.worker", self._bucket.url, run_id, *words]

    def written(self, run: RunReader) -> bool:
        """Whether it has a recent heartbeat.

        If this is wrong, the old attempt ends when it sees the newer one.
        """
        return run.status.alive

    def written_here(self, run: RunReader) -> bool:
        """False: a bucket does not say which machine writes into it."""
        return False

    def begin_anew(self, run_id: str) -> str:
        """Forget the run here; a new attempt does not change the earlier ones."""
        shutil.rmtree(self._folder / run_id)
        return f"{self._bucket.url}/{run_id}"

    def keep_log(self, log: Path) -> str:
        name = f"{LOGS}/{log.name}"
        try:
            self._bucket.write(name, log.read_bytes())
        except OSError as error:
            return f"none ({error})"
        return f"{self._bucket.url}/{name}"

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
