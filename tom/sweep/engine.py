"""Where a sweep's trainings run: processes of this machine, or of a cluster (`ray_engine`)."""

import signal
import sys
import time
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Protocol

from tom.machine import processes

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


class GoneError(Exception):
    """What the trainings run on is gone: none can be started, and none that runs be asked."""


class Engine(AbstractContextManager["Engine", None], Protocol):
    """Starts processes, `slots` at a time."""

    @property
    def slots(self) -> int:
        """How many may run at a time. Raises GoneError."""
        ...

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

    def __init__(self, process: processes.Process) -> None:
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


def spawn(words: Sequence[str], out: BinaryIO) -> processes.Process:
    """Start `python -m` followed by `words` with one thread; output to `out`.

    On the SIGTERM that it gets when the caller's thread ends, a training stops cleanly.
    """
    return processes.start([sys.executable, "-m", *words], out, processes.single_threaded())


def lives(process: Process, wait_s: float = 0.0) -> bool:
    """It has not ended, also not within `wait_s`."""
    until = time.monotonic() + wait_s
    while process.poll() is None:
        if time.monotonic() >= until:
            return True
        time.sleep(0.1)
    return False
