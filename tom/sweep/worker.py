"""A training whose run is in an object store: `python -m tom.sweep.worker URL OWN RUN_ID WORDS...`.

It trains in a folder of this machine and copies the run folder into the store as it grows, under an
attempt whose name ends with OWN, by which the driver knows it. A run to be resumed is fetched
first, unless this machine has more of it. Nothing is deleted here before the store has all of it,
unless another attempt has taken the run over: it makes the rest again, to the bit. The exit code is
that of `tom train`.
"""

import shutil
import signal
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from tom import plugins
from tom.errors import UserError
from tom.record import RunReader, checkpoint, layout
from tom.record.bucket import attempts
from tom.record.bucket.attempts import Attempt
from tom.record.bucket.objects import Bucket
from tom.record.lock import LostError
from tom.record.versions import ACCEPT
from tom.sweep import scratch
from tom.sweep.engine import LocalProcess, lives, spawn

PUT_S = 10.0  # the heartbeat in the store is at most this much older than the run's
LAST_PUTS, AGAIN_S = 30, 20.0  # attempts to put the end of a run, and the wait between them

KEPT = (ACCEPT, "--env=", "--steps=", "--termination=", f"{plugins.OPTION}=")
"""beginnings of the options that also apply to a resumed run"""


def main(url: str, own: str, run_id: str, words: Sequence[str]) -> int:
    """Returns the exit code of `tom train`, or 1 if the store failed."""
    try:
        with scratch.place(url, run_id) as store:
            try:
                return _work(Bucket.open(url), own, run_id, words, store)
            except (UserError, OSError) as error:  # the driver can reach it: try again
                raise OSError(f"{error}{_stays(store / run_id)}") from error
    except OSError as error:
        print(f"{run_id}: {error}", file=sys.stderr)
        return 1


def _stays(folder: Path) -> str:
    """A message with the place of a run folder that is not completely in the store."""
    if not (folder / layout.STATUS).exists():
        return ""
    return f"; all of it stays in {folder} on this machine, and the same command puts it there"


def _work(bucket: Bucket, own: str, run_id: str, words: Sequence[str], store: Path) -> int:
    """Train in the folder `store` and keep the bucket's copy up to date; returns the exit code."""
    keeper = Keeper(Attempt.claim(bucket, run_id, own), store / run_id)
    try:
        code = _train(_begin(keeper, words), keeper)
        keeper.put_the_end()
    except LostError:  # another attempt has taken the run over
        shutil.rmtree(keeper.folder, ignore_errors=True)
        raise
    shutil.rmtree(keeper.folder, ignore_errors=True)
    return code


def _begin(keeper: "Keeper", words: Sequence[str]) -> Sequence[str] | None:
    """Prepare the run folder; returns the words to start or resume it, None if it has finished."""
    bucket, run_id = keeper.attempt.bucket, keeper.attempt.run_id
    names = bucket.names(run_id)
    here = checkpoint.newest(keeper.folder / checkpoint.FOLDER)
    finished = RunReader(keeper.folder).status.state == "finished"
    if finished or (here is not None and here > attempts.newest_checkpoint(names)):
        keeper.earlier = attempts.newest(names)
        kept = [word for word in words if word.startswith(KEPT)]
        return None if finished else [f"--resume={run_id}", *kept]
    shutil.rmtree(keeper.folder, ignore_errors=True)
    if any(word.startswith("--resume=") for word in words):
        keeper.earlier = attempts.fetch(bucket, run_id, keeper.folder)
    return words


def _train(words: Sequence[str] | None, keeper: "Keeper") -> int:
    """Run `tom train` with `words` and put the run into the store as it grows; the exit code."""
    if words is None:
        return 0
    own = ("tom", "train", *words, "--no-rerun", f"--store={keeper.folder.parent}")
    process = LocalProcess(spawn(own, sys.stdout.buffer))
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        signal.signal(number, lambda *_: process.signal(signal.SIGTERM))
    try:
        wait_s = 1.0
        while lives(process, wait_s):
            keeper.put()
            wait_s = min(2 * wait_s, PUT_S)
    finally:
        process.end()  # also if another attempt has taken the run over
    ended = process.poll()
    return ended.code if ended and ended.code is not None and ended.code >= 0 else 1


@dataclass
class Keeper:
    """Keeps the store's copy of the run folder `folder` up to date, even if some puts fail."""

    attempt: Attempt
    folder: Path
    earlier: str | None = None
    """the attempt that this one resumes"""

    def put(self) -> bool:
        """Put the new parts of the run; False if the store failed. Raises LostError."""
        if not (self.folder / layout.STATUS).exists():
            return True  # the training has not started, or was refused
        try:
            self.attempt.put(self.folder)
            if self.earlier is not None:
                self.attempt.supersede(self.earlier)
                self.earlier = None
        except LostError:
            raise
        except OSError as error:
            print(f"{self.folder.name} could not be put into the store: {error}", file=sys.stderr)
            return False
        return True

    def put_the_end(self) -> None:
        """Put the ended run, trying for minutes if the store fails. Raises OSError in the end."""
        for _ in range(LAST_PUTS):
            if self.put():
                return
            time.sleep(AGAIN_S)
        raise OSError(f"the store took nothing for {LAST_PUTS * AGAIN_S / 60:.0f} minutes")


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1], sys.argv[2], sys.argv[3], sys.argv[4:]))
