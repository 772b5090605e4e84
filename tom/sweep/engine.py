"""Where many trainings run: processes here or of a Ray cluster, or a script for Slurm."""

import os
import secrets
import shlex
import socket
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from importlib.util import find_spec
from math import ceil
from pathlib import Path
from typing import TYPE_CHECKING, Union

from tom.errors import UserError
from tom.machine import processes
from tom.record import Store, layout

if TYPE_CHECKING:
    from tom.sweep.ray_engine import RayEngine, RayProcess

Engine = Union["LocalEngine", "RayEngine"]
Process = Union[processes.Process, "RayProcess"]
"""of one training, on any machine; its exit code is below zero where it was killed"""

ANSWER_S = 5.0  # a cluster's head answers within this
POLL_S = 0.1
GRACE_S = 20.0  # a training stops within this time after a request


DEFAULT_HOURS = 24
MARGIN = 1.5  # factor on the projected hours

SCRIPT = """\
#!/bin/bash
# {count} runs; submit with: mkdir -p {logs} && sbatch sweep.sh
# The store must lie on a file system that all nodes share.
#SBATCH --job-name=tom-sweep
#SBATCH --array=0-{last}
#SBATCH --cpus-per-task=1
#SBATCH --mem=8G
#SBATCH --time={hours}:00:00
#SBATCH --signal=B:TERM@300
#SBATCH --requeue
#SBATCH --open-mode=append
#SBATCH --output={logs}/slurm-%A_%a.log

# Before its time is up a task is sent SIGTERM: the training writes a checkpoint, and the task goes
# back into the queue, to go on from there.
again() {{
    kill -TERM "$task"
    wait "$task"
    scontrol requeue "${{SLURM_ARRAY_JOB_ID}}_${{SLURM_ARRAY_TASK_ID}}"
    exit 0
}}
trap again TERM

cd {folder} || exit 1
{command} --jobs 1 --only "$SLURM_ARRAY_TASK_ID" &
task=$!
wait "$task"
"""


class LocalEngine:
    """Starts processes of this machine, which the kernel ends together with the driver."""

    def __init__(self, slots: int) -> None:
        self.slots = slots
        """how many may run at a time; on a cluster that may raise GoneError"""

    def start(self, arguments: Sequence[str], log: Path) -> processes.Process:
        """Start `python -m` followed by `arguments`, with its output appended to `log`.

        Raises OSError if it cannot be started.
        """
        with log.open("ab") as out:
            return processes.start_module(arguments, out)


def open_engine(name: str, address: str | None, jobs: int | None) -> AbstractContextManager[Engine]:
    """The engine `local` or `ray`, for `jobs` trainings at a time (default: one per core).

    Ray's is of the cluster at `address`, or of one here that ends with the sweep. Every client of
    a cluster needs its token, because Ray listens on all interfaces and runs what it receives.
    Raises UserError if Ray is not installed or the cluster cannot be joined.
    """
    if name == "local":
        return nullcontext(LocalEngine(jobs or len(os.sched_getaffinity(0))))
    if find_spec("ray") is None:
        raise UserError('--engine ray needs Ray: pip install -e ".[cluster]"')
    # Ray reads these variables when it is imported.
    os.environ.setdefault("RAY_AUTH_MODE", "token")
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    if address is None:
        os.environ["RAY_AUTH_TOKEN"] = secrets.token_hex(32)
    else:
        _reach(address)
    from tom.sweep.ray_engine import RayEngine

    return RayEngine(address, jobs)


def _reach(address: str) -> None:
    """Raises UserError if nothing listens at HOST:PORT, because Ray would try for minutes."""
    host, _, port = address.rpartition(":")
    if not host or not port.isdecimal():
        raise UserError(f"--address {address}: must be HOST:PORT, as `ray start --head` prints it")
    try:
        socket.create_connection((host.strip("[]"), int(port)), ANSWER_S).close()
    except (OSError, OverflowError) as error:
        raise UserError(f"--address {address}: no Ray cluster answers there ({error})") from None


def train_all(commands: Mapping[str, Sequence[str]], workers: int | None = None) -> dict[str, int]:
    """Run `tom train` with the arguments of every name once; the exit codes by name.

    `workers` run at a time (default: one per core). On Ctrl-C or an error all running trainings are
    asked to stop, so that they end as `stopped` with whole folders; then the error is raised again.
    """
    workers = workers or len(os.sched_getaffinity(0))
    waiting, codes = list(commands.items()), dict[str, int]()
    running: dict[str, processes.Process] = {}
    try:
        while waiting or running:
            while waiting and len(running) < workers:
                name, arguments = waiting.pop(0)
                running[name] = processes.start_module(["tom", "train", *arguments], None)
            for name, process in list(running.items()):
                if (code := process.poll()) is not None:
                    codes[name] = code
                    del running[name]
            time.sleep(POLL_S)
    finally:
        processes.stop(list(running.values()), GRACE_S)
    return codes


def script(count: int, store: Path, arguments: Sequence[str], hours: float | None) -> str:
    """A sweep as a Slurm array of `count` tasks: a script that the user reads and submits.

    `arguments` are those of the `tom sweep` to run, `hours` what its longest training will take.
    """
    return SCRIPT.format(
        count=count,
        last=count - 1,
        hours=DEFAULT_HOURS if hours is None else max(ceil(hours * MARGIN), 1),
        logs=shlex.quote(str(Store(store.resolve()).beside(layout.LOGS))),
        folder=shlex.quote(str(Path.cwd())),
        command=shlex.join([sys.executable, "-m", "tom", *arguments]),
    ).rstrip()
