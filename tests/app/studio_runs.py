"""The recorded runs that the studio's tests look at (conftest.py records them)."""

import os
import shutil
import sys
import time
from collections.abc import Sequence
from copy import copy
from pathlib import Path
from tempfile import TemporaryFile

from common import change

from app.data import readers
from app.data.trainings import Started
from tom.machine import processes
from tom.record import layout
from tom.record.reader import RunReader

ROAD_TOM = "road-tom"
ROAD_MLE = "road-mle"
PENDULUM_TOM = "pendulum-tom-0"
RUNS = (
    (PENDULUM_TOM, "inverted-pendulum", "tom", {"seed": 0, "steps": 400}),
    ("pendulum-tom-1", "inverted-pendulum", "tom", {"seed": 1, "steps": 400}),
    ("pendulum-mle-0", "inverted-pendulum", "mle", {"seed": 0, "steps": 400}),
    (ROAD_MLE, "road-and-rocks", "mle", {"steps": 60, "fit_every": 30}),
    (ROAD_TOM, "road-and-rocks", "tom", {"steps": 60, "fit_every": 30}),
)


def info(store: Path, run_id: str) -> RunReader:
    """What the pages know of a run."""
    return next(run for run in readers.listing(str(store)).runs if run.run_id == run_id)


def altered(run: RunReader, **facts: object) -> RunReader:
    """The run with other facts than its folder's."""
    other = copy(run)
    other.__class__ = type("Altered", (type(run),), facts)
    vars(other).update(facts)
    return other


def stand_in(words: Sequence[str], program: str) -> Started:
    """What a page holds that has started `tom WORDS`, where a line of Python runs in its place."""
    log = TemporaryFile(buffering=0)  # noqa: SIM115 (the page reads it)
    command = [sys.executable, "-c", program]
    return Started(tuple(words), processes.start(command, log, outlives=True), log)


def with_weighing(store: Path, made: Path, folder: Path) -> Path:
    """A copy of the store in `folder` that has the weighing `made`."""
    path = folder / "store"
    shutil.copytree(store, path, copy_function=os.link)
    shutil.copytree(made, path / "weighings" / "made")
    return path


def set_status(run: Path, **changed: object) -> None:
    change(run / layout.STATUS, **changed)


def trains_elsewhere(run: Path) -> None:
    """The run as another machine would write it; it looks alive for the next 55 s."""
    (run / layout.LOCK).unlink(missing_ok=True)
    set_status(run, state="running", heartbeat=time.time() + 25)
