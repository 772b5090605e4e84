"""Many trainings as processes of their own: one single-threaded process a core."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, field
from pathlib import Path

from tom.machine.parent import end_with_parent

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
        _stop([process for _, process in running.values()])
    return codes


def _start(command: Command) -> subprocess.Popen[bytes]:
    """Start a training that the kernel asks to stop when this process dies."""
    with command.log.open("wb") if command.log else nullcontext() as log:
        return subprocess.Popen(
            [sys.executable, "-m", "tom", "train", *command.arguments],
            env={**os.environ, "OMP_NUM_THREADS": "1", **command.environment},
            start_new_session=True,
            stdout=log,
            stderr=log,
            preexec_fn=end_with_parent if sys.platform == "linux" else None,
        )


def _stop(processes: Sequence[subprocess.Popen[bytes]]) -> None:
    for process in processes:
        process.send_signal(signal.SIGTERM)
    for process in processes:
        try:
            process.wait(GRACE_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
