"""A sweep whose runs lie in an object store: its driver's view of them, and the worker of a run.

`python -m tom.sweep.bucket URL OWN RUN_ID OPTIONS...` trains in a folder of this machine and copies
the run folder into the bucket as it grows, under an attempt whose name ends with OWN, by which the
driver knows it. A run that is there is fetched first, unless this machine has more of it. Nothing
is deleted here before the bucket has all of it, unless another attempt has taken the run over: it
makes the rest again, to the bit. The exit code is that of `tom train`, and "try later" if the
bucket failed or another attempt has the run.
"""

import hashlib
import os
import secrets
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from subprocess import TimeoutExpired
from typing import Any, Literal

from tom.errors import TRY_LATER, UserError
from tom.machine import processes
from tom.record import RunReader, Store, checkpoint, layout, lock
from tom.record.bucket import CLAIM, Attempt, Bucket, checkpoints, fetch, newest
from tom.record.lock import LostError
from tom.sweep.driver import Clock, FolderBackend

LOOK_S = 5.0  # between two updates of a bucket's run
LEASE_S = 600.0
"""seconds without a change after which a running run in a bucket counts as nobody's

A live one is put every 10 s, but its status after all else: a run of Humanoid that goes on puts two
checkpoints of 200 MB first, which is ten minutes at 6 Mbit/s. Its end is tried for as long.
"""
PUT_S = 10.0  # the heartbeat in the bucket is at most this much older than the run's
LAST_PUTS, AGAIN_S = 30, 20.0  # attempts to put the end of a run, and the wait between them


class BucketBackend(FolderBackend):
    """The runs `run_ids` in `bucket`.

    `store` is a folder of this machine for as long as the sweep runs. For every run it holds the
    settings, the status and the names of the checkpoints.
    """

    lease_s = LEASE_S

    def __init__(
        self,
        bucket: Bucket,
        store: Store,
        run_ids: Sequence[str],
        clock: Clock = time.monotonic,
    ) -> None:
        """Raises OSError if the bucket does not answer."""
        super().__init__(store, clock)
        self._bucket = bucket
        self._next: dict[str, float] = {}
        self._own = secrets.token_hex(4)  # the attempts of this driver end with it
        for run_id in run_ids:
            self.update(run_id, now=True)

    def update(self, run_id: str, *, now: bool = False) -> None:
        if not now and self._clock() < self._next.get(run_id, 0.0):
            return
        self._next[run_id] = self._clock() + LOOK_S
        path = self.store.path / run_id
        try:
            names = self._bucket.names(run_id)
            attempt, claimed = newest(names), newest(names, CLAIM)
            if attempt is not None:
                path.mkdir(parents=True, exist_ok=True)
                for name in (layout.CONFIG, layout.STATUS):
                    content = self._bucket.read(f"{run_id}/{attempt}/{name}")
                    (path / name).write_bytes(content)
                shutil.rmtree(path / checkpoint.FOLDER, ignore_errors=True)
                for step in checkpoints(names):
                    (path / checkpoint.FOLDER / step).mkdir(parents=True)
        except OSError:
            self._seen.clear()  # whoever writes runs may not have reached the store either
            raise
        # A claim that is not the run yet: its worker may be fetching, or putting.
        begins = claimed is not None and (attempt is None or claimed > attempt)
        status = RunReader(path).status
        runs = claimed is not None and claimed == attempt and status.state == "running"
        self._note_sign(run_id, (claimed, status) if begins or runs else None)

    def command(self, run_id: str, options: Sequence[str]) -> list[str]:
        return ["tom.sweep.bucket", self._bucket.url, self._own, run_id, *options]

    def writer(self, run: RunReader) -> Literal["away"] | None:
        """Another machine, if the run is claimed, says that it is running, and changed recently.

        If this is wrong, the old attempt ends when it sees the newer one.
        """
        return "away" if self._is_leased(run.run_id) else None

    def ended(self, run_id: str) -> None:
        """Take back its claim, so that neither this machine nor another one waits for it.

        A worker on a machine that was lost may still train: it ends when it sees a newer attempt.
        """
        claim = f"-{self._own}/{CLAIM}"
        self._bucket.remove(name for name in self._bucket.names(run_id) if name.endswith(claim))

    def keep_log(self, log: Path) -> str:
        name = f"{layout.LOGS}/{log.name}"
        try:
            self._bucket.write(name, log.read_bytes())
        except OSError as error:
            return f"none ({error})"
        return f"{self._bucket.url}/{name}"


@contextmanager
def open_backend(store: Path | str, run_ids: Sequence[str]) -> Iterator[FolderBackend]:
    """The storage of these runs: a folder or s3://BUCKET/PREFIX.

    Raises UserError if an object store cannot be reached.
    """
    if isinstance(store, Path):
        yield FolderBackend(Store(store))
        return
    with tempfile.TemporaryDirectory(prefix="tom-sweep-") as folder:
        try:
            backend = BucketBackend(Bucket.open(store), Store(folder), run_ids)
        except OSError as error:
            raise UserError(f"{store}: {error}") from error
        yield backend


class Worker:
    """Trains a run in `folder` and keeps the bucket's copy up to date, even if some puts fail."""

    def __init__(self, bucket: Bucket, own: str, folder: Path) -> None:
        self.folder = folder
        self._attempt = Attempt.claim(bucket, folder.name, own)
        self._earlier: str | None = None  # the attempt that this one resumes
        self._fetched: dict[str, Any] = {}  # the `config.json` of that attempt's run

    def work(self, options: Sequence[str]) -> int:
        """Fetch the run unless this machine has more of it, train it, and put it back.

        Returns the exit code. Raises LostError if another attempt has taken the run over.
        """
        bucket, run_id = self._attempt.bucket, self._attempt.run_id
        names = bucket.names(run_id)
        saved = max(map(int, checkpoints(names)), default=-1)
        at = checkpoint.newest(self.folder / checkpoint.FOLDER)
        if (at is not None and at > saved) or RunReader(self.folder).status.state == "finished":
            self._earlier = newest(names)
        else:
            shutil.rmtree(self.folder, ignore_errors=True)
            self._earlier = fetch(bucket, run_id, self.folder)
        self._fetched = RunReader(self.folder).config
        code = self._train(options)
        for _ in range(LAST_PUTS):
            if self._put_in_bucket():
                return code
            time.sleep(AGAIN_S)
        raise OSError(f"the store took nothing for {LAST_PUTS * AGAIN_S / 60:.0f} minutes")

    def _train(self, options: Sequence[str]) -> int:
        """Run `tom train` and put the run into the bucket as it grows; returns the exit code."""
        command = ("tom", "train", *options, "--no-rerun", f"--store={self.folder.parent}")
        process = processes.start_module(command, sys.stdout.buffer)
        for number in processes.STOPPING:
            signal.signal(number, lambda *_: process.terminate())
        wait_s = 1.0
        try:
            while True:
                with suppress(TimeoutExpired):
                    code = process.wait(wait_s)
                    return code if code >= 0 else TRY_LATER
                if RunReader(self.folder).config != self._fetched:  # else it may yet begin anew
                    self._put_in_bucket()
                wait_s = min(2 * wait_s, PUT_S)
        finally:
            process.kill()  # if another attempt has taken the run over
            process.wait()

    def _put_in_bucket(self) -> bool:
        """Put the new parts of the run; False if the bucket failed. Raises LostError."""
        if not (self.folder / layout.STATUS).exists():
            return True  # the training has not started, or was refused
        bucket, run_id = self._attempt.bucket, self._attempt.run_id
        try:
            self._attempt.put(self.folder)
            if self._earlier is None:
                return True
            if RunReader(self.folder).config.get("created") == self._fetched.get("created"):
                bucket.remove(bucket.names(f"{run_id}/{self._earlier}"))  # this one has all of it
            else:  # the run could not go on and began anew
                print(f"{run_id}: what was there stays in the store as attempt {self._earlier}")
            self._earlier = None
            return True
        except LostError:
            raise
        except OSError as error:
            print(f"{run_id} could not be put into the bucket: {error}", file=sys.stderr)
            return False


def local_store(url: str, run_id: str) -> Path:
    """A local run store for `run_id` until `url` has all of it: the same one for every attempt.

    It is in the user's own temporary folder. Raises UserError if others may write there.
    """
    root = Path(tempfile.gettempdir(), f"tom-runs-{os.getuid()}")
    with suppress(FileExistsError):
        root.mkdir(mode=0o700)
    status = root.lstat()
    own = status.st_uid == os.getuid() and not status.st_mode & 0o022
    if not own or not root.is_dir() or root.is_symlink():
        raise UserError(f"others may write into {root}: remove it, or choose another TMPDIR")
    return root / f"{hashlib.sha256(url.encode()).hexdigest()[:12]}-{run_id}"


def main(url: str, own: str, run_id: str, options: Sequence[str]) -> int:
    stays = ""
    try:
        store = local_store(url, run_id)
        store.mkdir(exist_ok=True)
        stays = f"; all of it stays in {store} on this machine, and the same command puts it there"
        with lock.exclusive_lock(store):
            bucket = Bucket.open(url)
            while lock.is_held(
                store / run_id
            ):  # a training whose worker was killed saves its state
                time.sleep(0.1)
            try:
                code = Worker(bucket, own, store / run_id).work(options)
            except LostError:
                shutil.rmtree(store)
                stays = ""
                raise
            shutil.rmtree(store)
            return code
    except (UserError, OSError) as error:  # the driver can reach the bucket: try again
        print(f"{run_id}: {error}{stays}", file=sys.stderr)
    return TRY_LATER


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1], sys.argv[2], sys.argv[3], sys.argv[4:]))
