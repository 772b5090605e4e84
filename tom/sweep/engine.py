"""The processes of a sweep's trainings, on this machine or on a cluster (`ray_engine`)."""

import signal
import sys
import time
from collections.abc import Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO, Protocol

from tom.machine import processes

KILL_S = 10.0  # a killed process has ended within this time


@dataclass(frozen=True)
class Exit:
    """How a process ended; `code` is None if nobody saw it end."""

    code: int | None
    why: str = ""


class Process(Protocol):
    """The process of one training, on any machine."""

    def poll(self) -> Exit | None:
        """How it ended; None as long as this is unknown."""
        ...

    def signal(self, number: signal.Signals) -> None:
        """Send it a signal, unless it has ended."""
        ...

    def silent_s(self) -> float:
        """Seconds since the last sign of its machine; 0 before it has started."""
        ...

    def end(self) -> None:
        """Kill it if it still runs, and release it."""
        ...


class GoneError(Exception):
    """The cluster is gone: no training can be started, and the running ones cannot be reached."""


class Engine(AbstractContextManager["Engine", None], Protocol):
    """Starts processes, `slots` at a time."""

    @property
    def slots(self) -> int:
        """How many may run at a time. Raises GoneError."""
        ...

    def start(self, words: Sequence[str], log: Path) -> Process:
        """Start `python -m` followed by `words`, with its output appended to `log`.

        Raises OSError if it cannot be started.
        """
        ...


class LocalEngine(AbstractContextManager["LocalEngine", None]):
    """Starts processes of this machine, which the kernel ends together with the driver."""

    def __init__(self, slots: int) -> None:
        self.slots = slots

    def start(self, words: Sequence[str], log: Path) -> "LocalProcess":
        with log.open("ab") as out:
            return LocalProcess(spawn(words, out))

    def __exit__(self, *_: object) -> None:
        """There is nothing to close: the driver ends the processes that it started."""


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
    """Start `python -m` followed by `words` with one thread, with its output to `out`.

    It gets SIGTERM when the caller's thread ends, on which a training stops cleanly.
    """
    return processes.start([sys.executable, "-m", *words], out, processes.single_threaded())


def lives(process: Process, wait_s: float = 0.0) -> bool:
    """Whether it still runs after `wait_s` seconds; returns early if it ends before."""
    until = time.monotonic() + wait_s
    while process.poll() is None:
        if time.monotonic() >= until:
            return True
        time.sleep(0.1)
    return False
