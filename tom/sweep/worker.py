"""A training whose run is in a bucket: `python -m tom.sweep.worker URL OWN RUN_ID OPTIONS...`.

It trains in a folder of this machine and copies the run folder into the bucket as it grows, under
an attempt whose name ends with OWN, by which the driver knows it. A run that is there is fetched
first, unless this machine has more of it. Nothing is deleted here before the bucket has all of it,
unless another attempt has taken the run over: it makes the rest again, to the bit. The exit code is
that of `tom train`, and "try later" if the bucket failed or another attempt has the run.
"""

import hashlib
import os
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from subprocess import TimeoutExpired
from typing import Any

from tom.errors import TRY_LATER, UserError
from tom.machine import processes
from tom.record import RunReader, checkpoint, layout, lock
from tom.record.bucket import attempts
from tom.record.bucket.attempts import Attempt
from tom.record.bucket.objects import Bucket
from tom.record.lock import LostError

PUT_S = 10.0  # the heartbeat in the bucket is at most this much older than the run's
LAST_PUTS, AGAIN_S = 30, 20.0  # attempts to put the end of a run, and the wait between them


def main(url: str, own: str, run_id: str, options: Sequence[str]) -> int:
    """Returns the exit code."""
    stays = ""
    try:
        store = local_store(url, run_id)
        store.mkdir(exist_ok=True)
        stays = f"; all of it stays in {store} on this machine, and the same command puts it there"
        with lock.alone_in(store):
            return _work(Bucket.open(url), own, store / run_id, options)
    except LostError as error:
        print(f"{run_id}: {error}", file=sys.stderr)
    except (UserError, OSError) as error:  # the driver can reach the bucket: try again
        print(f"{run_id}: {error}{stays}", file=sys.stderr)
    return TRY_LATER


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


def _work(bucket: Bucket, own: str, folder: Path, options: Sequence[str]) -> int:
    """Train in `folder` and keep the bucket's copy up to date; returns the exit code."""
    while lock.held(folder):  # a training whose worker was killed writes its checkpoint
        time.sleep(0.1)
    upload = Upload(Attempt.claim(bucket, folder.name, own), folder)
    try:
        upload.fetch()
        code = _train(options, upload)
        upload.put_the_end()
    except LostError:  # another attempt has taken the run over
        shutil.rmtree(folder.parent)
        raise
    shutil.rmtree(folder.parent)
    return code


def _train(options: Sequence[str], upload: "Upload") -> int:
    """Run `tom train` and put the run into the bucket as it grows; returns the exit code."""
    command = ("tom", "train", *options, "--no-rerun", f"--store={upload.folder.parent}")
    process = processes.start_module(command, sys.stdout.buffer)
    for number in processes.STOPPING:
        signal.signal(number, lambda *_: process.terminate())
    wait_s = 1.0
    try:
        while True:
            with suppress(TimeoutExpired):
                code = process.wait(wait_s)
                return code if code >= 0 else TRY_LATER
            if upload.begun:
                upload.put()
            wait_s = min(2 * wait_s, PUT_S)
    finally:
        process.kill()  # if another attempt has taken the run over
        process.wait()


@dataclass
class Upload:
    """Keeps the bucket's copy of the run folder `folder` up to date, even if some puts fail."""

    attempt: Attempt
    folder: Path
    earlier: str | None = None
    """the attempt that this one resumes"""
    fetched: Mapping[str, Any] = field(default_factory=dict)
    """the `config.json` of that attempt's run"""

    def fetch(self) -> None:
        """Fetch the run, unless this machine has more of it."""
        bucket, run_id = self.attempt.bucket, self.attempt.run_id
        names = bucket.names(run_id)
        at = checkpoint.newest(self.folder / checkpoint.FOLDER)
        ahead = at is not None and at > attempts.newest_checkpoint(names)
        if ahead or RunReader(self.folder).status.state == "finished":
            self.earlier = attempts.newest(names)
        else:
            shutil.rmtree(self.folder, ignore_errors=True)
            self.earlier = attempts.fetch(bucket, run_id, self.folder)
        self.fetched = RunReader(self.folder).config

    @property
    def begun(self) -> bool:
        """Whether the training goes on with the run; before that it may yet begin it anew."""
        return RunReader(self.folder).config != self.fetched

    def put(self) -> bool:
        """Put the new parts of the run; False if the bucket failed. Raises LostError."""
        if not (self.folder / layout.STATUS).exists():
            return True  # the training has not started, or was refused
        try:
            self.attempt.put(self.folder)
            if self.earlier is not None:
                self._supersede(self.earlier)
                self.earlier = None
        except LostError:
            raise
        except OSError as error:
            print(f"{self.folder.name} could not be put into the bucket: {error}", file=sys.stderr)
            return False
        return True

    def put_the_end(self) -> None:
        """Put the ended run, trying for minutes if the bucket fails. Raises OSError in the end."""
        for _ in range(LAST_PUTS):
            if self.put():
                return
            time.sleep(AGAIN_S)
        raise OSError(f"the store took nothing for {LAST_PUTS * AGAIN_S / 60:.0f} minutes")

    def _supersede(self, earlier: str) -> None:
        """Remove the earlier attempt, unless the run could not go on and began anew."""
        if RunReader(self.folder).config.get("created") == self.fetched.get("created"):
            self.attempt.supersede(earlier)
        else:
            print(f"{self.folder.name}: what was there stays in the store as attempt {earlier}")


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1], sys.argv[2], sys.argv[3], sys.argv[4:]))
