"""Where a sweep's trainings run: processes of this machine, or of a cluster (`ray_engine`)."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Protocol

from tom.machine.parent import end_with_parent

KILL_S = 10.0  # a process that is killed is gone within this


@dataclass(frozen=True)
class Exit:
    """How a process ended; `code` is None where nobody saw it end."""

    code: int | None
    why: str = ""


class Process(Protocol):
    """One training, wherever it runs."""

    def poll(self) -> Exit | None:
        """How it ended; None as long as that is not known."""
        ...

    def signal(self, number: signal.Signals) -> None:
        """Send it a signal; none where it has ended."""
        ...

    def silent_s(self) -> float:
        """Seconds in which nothing was heard from where it runs; 0 before it has begun."""
        ...

    def end(self) -> None:
        """Kill it where it still runs and let go of it."""
        ...


class Engine(AbstractContextManager["Engine", None], Protocol):
    """Starts processes, `slots` at a time."""

    @property
    def slots(self) -> int: ...

    def start(self, words: Sequence[str], log: Path) -> Process:
        """Start `python -m` followed by `words`; what it prints is appended to `log`.

        Raises OSError where it cannot be started.
        """
        ...


class LocalEngine(AbstractContextManager["LocalEngine", None]):
    """Processes of this machine, which the kernel ends with the driver."""

    def __init__(self, slots: int) -> None:
        self.slots = slots

    def start(self, words: Sequence[str], log: Path) -> "LocalProcess":
        with log.open("ab") as out:
            return LocalProcess(spawn(words, out))

    def __exit__(self, *_: object) -> None:
        """Nothing is left to close: the driver ends what it started."""


class LocalProcess:
    """A process of this machine."""

    def __init__(self, process: subprocess.Popen[bytes]) -> None:
        self.process = process

    def poll(self) -> Exit | None:
        code = self.process.poll()
        if code is None:
            return None
        return Exit(code, f"killed by signal {-code}" if code < 0 else "")

    def signal(self, number: signal.Signals) -> None:
        if self.process.poll() is None:
            self.process.send_signal(number)

    def silent_s(self) -> float:
        return 0.0

    def end(self) -> None:
        self.signal(signal.SIGKILL)
        self.process.wait()


def spawn(words: Sequence[str], out: BinaryIO) -> subprocess.Popen[bytes]:
    """Start `python -m` followed by `words`: one thread, a session of its own, output to `out`.

    Ends with the thread that called this: the kernel sends SIGTERM then.
    """
    return subprocess.Popen(
        [sys.executable, "-m", *words],
        env={**os.environ, "OMP_NUM_THREADS": "1"},
        stdin=subprocess.DEVNULL,
        stdout=out,
        stderr=out,
        start_new_session=True,  # Ctrl-C is the driver's to pass on
        preexec_fn=end_with_parent,  # on SIGTERM a training stops cleanly
    )


def lives(process: Process, wait_s: float = 0.0) -> bool:
    """It has not ended, also not within `wait_s`."""
    until = time.monotonic() + wait_s
    while process.poll() is None:
        if time.monotonic() >= until:
            return True
        time.sleep(0.1)
    return False
