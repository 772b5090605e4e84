"""The processes of many trainings, on this machine or on a cluster (`ray_engine`)."""

import os
import secrets
import socket
import time
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Union

from tom.errors import UserError
from tom.machine import processes

if TYPE_CHECKING:
    from tom.sweep.ray_engine import RayEngine, RayProcess

Engine = Union["LocalEngine", "RayEngine"]
Process = Union[processes.Process, "RayProcess"]
"""of one training, on any machine; its exit code is below zero where it was killed"""

ANSWER_S = 5.0  # a cluster's head answers within this
POLL_S = 0.1
GRACE_S = 20.0  # a training stops within this time after a request


class LocalEngine(AbstractContextManager["LocalEngine", None]):
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

    def __exit__(self, *_: object) -> None:
        """The driver ends the processes that it started."""


def open_engine(name: str, address: str | None, jobs: int | None) -> Engine:
    """The engine `local` or `ray`, for `jobs` trainings at a time (default: one per core).

    Ray's is of the cluster at `address`, or of one here that ends with the sweep. Every client of
    a cluster needs its token, because Ray listens on all interfaces and runs what it receives.
    Raises UserError if Ray is not installed or the cluster cannot be joined.
    """
    if name == "local":
        return LocalEngine(jobs or len(os.sched_getaffinity(0)))
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
