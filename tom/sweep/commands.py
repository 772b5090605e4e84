"""Many trainings as processes of their own: one single-threaded process a core."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

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
    jobs: Sequence[Command],
    workers: int | None = None,
    finished: Callable[[Command, int], None] = lambda job, code: None,
) -> dict[str, int]:
    """Run all jobs, `workers` at a time (default: one a core); exit codes by job name.

    `finished` is told of every job as it ends. On Ctrl-C or an error all running trainings are
    asked to stop (they end as `stopped`, their folders whole) before the error goes on.
    """
    workers = workers or len(os.sched_getaffinity(0))
    waiting, running, codes = list(jobs), {}, {}
    try:
        while waiting or running:
            while waiting and len(running) < workers:
                job = waiting.pop(0)
                running[job.name] = (job, _start(job))
            for name, (job, process) in list(running.items()):
                code = process.poll()
                if code is not None:
                    del running[name]
                    codes[name] = code
                    finished(job, code)
            time.sleep(POLL_S)
    finally:
        _stop([process for _, process in running.values()])
    return codes


def _start(job: Command) -> subprocess.Popen[bytes]:
    environment = {**os.environ, "OMP_NUM_THREADS": "1", **job.environment}
    command = [sys.executable, "-m", "tom", "train", *job.arguments]
    if job.log is None:
        return subprocess.Popen(command, env=environment, start_new_session=True)
    with job.log.open("wb") as log:
        return subprocess.Popen(
            command, env=environment, start_new_session=True, stdout=log, stderr=log
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
