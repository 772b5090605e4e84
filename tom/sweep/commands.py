"""Many trainings as processes of their own: one single-threaded process a core."""

import os
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path

from tom.machine.processes import Process, single_threaded, start, stop

POLL_S = 0.1
GRACE_S = 20.0  # a training stops within this once it is asked to


@dataclass(frozen=True)
class Command:
    """One `tom train` and where its output goes."""

    name: str
    arguments: tuple[str, ...]
    log: Path | None = None
    environment: dict[str, str] = field(default_factory=dict)


def run_commands(
    commands: Sequence[Command],
    workers: int | None = None,
    finished: Callable[[Command, int], None] = lambda command, code: None,
) -> dict[str, int]:
    """Run all commands, `workers` at a time (default: one a core); exit codes by command name.

    `finished` is told of every command as it ends. On Ctrl-C or an error all running trainings are
    asked to stop (they end as `stopped`, their folders whole) before the error goes on.
    """
    workers = workers or len(os.sched_getaffinity(0))
    waiting, running, codes = list(commands), {}, {}
    try:
        while waiting or running:
            while waiting and len(running) < workers:
                command = waiting.pop(0)
                running[command.name] = (command, _start(command))
            for name, (command, process) in list(running.items()):
                code = process.poll()
                if code is not None:
                    del running[name]
                    codes[name] = code
                    finished(command, code)
            time.sleep(POLL_S)
    finally:
        stop([process for _, process in running.values()], GRACE_S)
    return codes


def _start(command: Command) -> Process:
    words = [sys.executable, "-m", "tom", "train", *command.arguments]
    with command.log.open("wb") if command.log else nullcontext() as log:
        return start(words, log, single_threaded(**command.environment))
