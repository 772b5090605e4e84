"""The recorded runs that the studio's tests look at (conftest.py records them)."""

import os
import shutil
from pathlib import Path

from app.data import readers
from app.data.readers import RunInfo

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


def info(store: Path, run_id: str) -> RunInfo:
    """What the pages know of a run."""
    return next(run for run in readers.listing(str(store)).runs if run.run_id == run_id)


def with_weighing(store: Path, made: Path, folder: Path) -> Path:
    """A copy of the store in `folder` that has the weighing `made`."""
    path = folder / "store"
    shutil.copytree(store, path, copy_function=os.link)
    shutil.copytree(made, path / "weighings" / "made")
    return path
