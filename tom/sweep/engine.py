"""The processes of a sweep's trainings, on this machine or on a cluster (`ray_engine`)."""

import sys
from collections.abc import Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import IO, Protocol

from tom.machine import processes


class Process(Protocol):
    """The process of one training, on any machine; one of this machine is a `Popen`."""

    def poll(self) -> int | None:
        """Its exit code, below zero if it was killed or its machine died; None while it runs."""
        ...

    def terminate(self) -> None:
        """Ask it to stop with a checkpoint, unless it has ended."""
        ...

    def kill(self) -> None:
        """End it at once, unless it has ended."""
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

    def start(self, words: Sequence[str], log: Path) -> processes.Process:
        with log.open("ab") as out:
            return spawn(words, out)

    def __exit__(self, *_: object) -> None:
        """There is nothing to close: the driver ends the processes that it started."""


def spawn(words: Sequence[str], out: IO[bytes]) -> processes.Process:
    """Start `python -m` followed by `words` with one thread, with its output to `out`.

    It gets SIGTERM when the caller's thread ends, on which a training stops cleanly.
    """
    return processes.start([sys.executable, "-m", *words], out, processes.single_threaded())
