"""Many trainings as separate processes: one single-threaded process per core."""

import os
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path

from tom.machine.processes import Process, single_threaded, start, stop

POLL_S = 0.1
GRACE_S = 20.0  # a training stops within this time after a request


@dataclass(frozen=True)
class Command:
    """The arguments of one `tom train`, and the file for its output."""

    name: str
    arguments: tuple[str, ...]
    log: Path | None = None
    environment: dict[str, str] = field(default_factory=dict)


def run_commands(
    commands: Sequence[Command],
    workers: int | None = None,
    finished: Callable[[Command, int], None] = lambda command, code: None,
) -> dict[str, int]:
    """Run all commands, `workers` at a time (default: one per core); exit codes by command name.

    `finished` is called with every command that has ended and its exit code. On Ctrl-C or an error
    all running trainings are asked to stop, so that they end as `stopped` with whole folders; then
    the error is raised again.
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
