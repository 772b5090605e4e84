"""Trainings as processes of this machine: start, stop, and whether they are alive."""

import os
import signal
import sys
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryFile
from typing import BinaryIO

from app.links import VARIABLE
from tom.errors import UserError
from tom.machine import processes
from tom.record import lock
from tom.record.store import Store

LOG_TAIL, LOG_TAIL_BYTES = 8, 64_000


@dataclass
class Started:
    """A command that this studio started."""

    arguments: tuple[str, ...]
    """the arguments of `tom`"""
    process: processes.Process
    log: BinaryIO
    """its output: an unnamed file, which vanishes when no process has it open"""

    def tail(self) -> str:
        """The last lines of its output."""
        handle = self.log.fileno()
        size = os.fstat(handle).st_size
        start = max(size - LOG_TAIL_BYTES, 0)
        # pread, because the training writes at the file offset that both share
        output = os.pread(handle, size - start, start).decode(errors="replace")
        return "\n".join(output.splitlines()[-LOG_TAIL:])


def start(arguments: Sequence[str]) -> Started:
    """Run `tom WORDS` in a new session, so that it outlives the studio."""
    # Without the studio's key: a training runs plug-ins, and outlives the studio.
    environment = {name: value for name, value in os.environ.items() if name != VARIABLE}
    log = TemporaryFile(buffering=0)  # noqa: SIM115 (open as long as somebody may look at it)
    command = [sys.executable, "-m", "tom", *arguments]
    process = processes.start(command, log, environment, outlives=True)
    return Started(tuple(arguments), process, log)


def stop(store: Store, run_id: str) -> None:
    """Ask the process that writes a run to stop after its step, with a checkpoint.

    Raises UserError if the run is not training, or not in a process of this machine that may be
    signalled.
    """
    run = store.run(run_id)
    if not run.status.alive:
        raise UserError(f"run '{run_id}' is not in training: nothing to stop")
    here = False
    with suppress(OSError):  # no such process, or another user's
        if here := lock.is_open_by(run.status.pid, run.path):
            os.kill(run.status.pid, signal.SIGTERM)
    if not here:
        raise UserError(
            f"run '{run_id}' trains on another machine or for another user: stop it there"
        )


def memory(pid: int, run: Path) -> int | None:
    """The resident bytes of the process that writes a run; None if it is not on this machine."""
    try:
        if not lock.is_open_by(pid, run):
            return None
        pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    except (OSError, ValueError, IndexError):
        return None
    return pages * os.sysconf("SC_PAGE_SIZE")


def has_ended(run: Path) -> bool:
    """Whether the process that wrote the run folder has ended; False if on another machine."""
    return bool(lock.was_written_here(run)) and not lock.is_held(run)
