"""Many `tom train`, each a single-threaded process of this machine and a run of its own."""

import os
import sys
import time
from collections.abc import Mapping, Sequence

from tom.machine.processes import Process, single_threaded, start, stop

POLL_S = 0.1
GRACE_S = 20.0  # a training stops within this time after a request


def train_all(commands: Mapping[str, Sequence[str]], workers: int | None = None) -> dict[str, int]:
    """Run `tom train` with the arguments of every name; the exit codes by name.

    `workers` run at a time (default: one per core). On Ctrl-C or an error all running trainings are
    asked to stop, so that they end as `stopped` with whole folders; then the error is raised again.
    """
    workers = workers or len(os.sched_getaffinity(0))
    waiting, codes = list(commands.items()), dict[str, int]()
    running: dict[str, Process] = {}
    try:
        while waiting or running:
            while waiting and len(running) < workers:
                name, arguments = waiting.pop(0)
                words = [sys.executable, "-m", "tom", "train", *arguments]
                running[name] = start(words, None, single_threaded())
            for name, process in list(running.items()):
                if (code := process.poll()) is not None:
                    codes[name] = code
                    del running[name]
            time.sleep(POLL_S)
    finally:
        stop(list(running.values()), GRACE_S)
    return codes
