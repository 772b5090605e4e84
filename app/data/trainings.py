"""Trainings as processes of this machine: started and stopped for a page, and whether they live."""

import os
import signal
import subprocess
import sys
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryFile
from typing import BinaryIO

from app.links import VARIABLE
from tom.errors import UserError
from tom.record import layout, lock
from tom.record.store import Store

LOG_TAIL, LOG_TAIL_BYTES = 8, 64_000


@dataclass
class Started:
    """A training that this studio started."""

    words: tuple[str, ...]
    """what follows `tom` on the command line"""
    process: subprocess.Popen[bytes]
    log: BinaryIO
    """what it prints: a file without a name, which ends with the last process that has it open"""
    recorded: bool = False
    """a run that it writes has been seen: from then on that run says how it goes"""

    def failed(self, writers: Collection[int]) -> bool:
        """It ended badly before it had a run; `writers` are the processes of all known runs."""
        self.recorded = self.recorded or self.process.pid in writers
        return self.process.poll() not in (None, 0) and not self.recorded

    def tail(self) -> str:
        """The last lines of what it printed."""
        handle = self.log.fileno()
        size = os.fstat(handle).st_size
        start = max(size - LOG_TAIL_BYTES, 0)
        # pread, as the training writes at the place that both share
        output = os.pread(handle, size - start, start).decode(errors="replace")
        return "\n".join(output.splitlines()[-LOG_TAIL:])


def start(words: Sequence[str]) -> Started:
    """Run `tom WORDS` in a session of its own: it outlives the studio."""
    environment = {name: value for name, value in os.environ.items() if name != VARIABLE}
    log = TemporaryFile(buffering=0)  # noqa: SIM115 (open as long as somebody may look at it)
    process = subprocess.Popen(
        [sys.executable, "-m", "tom", *words],
        env=environment,
        stdin=subprocess.DEVNULL,
        stdout=log,
        stderr=log,
        start_new_session=True,
    )
    return Started(tuple(words), process, log)


def stop(store: Store, run_id: str) -> None:
    """Ask the process that writes a run to stop at the end of its step, with a checkpoint.

    Raises UserError where the run is not in training, or not by a process of this machine that
    may be signalled. The process is held before it is looked at, so no other can get the signal.
    """
    run = store.run(run_id)
    if not run.status.alive:
        raise UserError(f"run '{run_id}' is not in training: nothing to stop")
    elsewhere = UserError(
        f"run '{run_id}' trains on another machine or for another user: stop it there"
    )
    if sys.platform != "linux":
        raise elsewhere
    try:
        process = os.pidfd_open(run.status.pid)
    except OSError:
        raise elsewhere from None
    try:
        if not _writes(run.status.pid, run.path):
            raise elsewhere
        signal.pidfd_send_signal(process, signal.SIGTERM)
    except OSError:
        raise elsewhere from None
    finally:
        os.close(process)


def gone(run: Path) -> bool:
    """The process of this machine that wrote the run folder has ended; False for any other's."""
    return bool(lock.written_here(run)) and not lock.held(run)


def _writes(pid: int, run: Path) -> bool:
    """Process `pid` has the lock file of the run folder open."""
    own = (run / layout.LOCK).stat()
    for link in Path(f"/proc/{pid}/fd").iterdir():
        try:
            found = link.stat()
        except OSError:
            continue  # closed meanwhile
        if (found.st_dev, found.st_ino) == (own.st_dev, own.st_ino):
            return True
    return False
