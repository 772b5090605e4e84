"""A sweep's backend (where runs are stored) and engine (where trainings run), from options."""

import argparse
import os
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path

from tom.errors import UserError
from tom.record import Store
from tom.record.bucket.objects import Bucket
from tom.sweep.backend import Backend, FolderBackend
from tom.sweep.bucket_backend import BucketBackend
from tom.sweep.cluster import open_ray
from tom.sweep.engine import Engine, LocalEngine
from tom.training.plan import Trial


def place(word: str) -> Path | str:
    """A folder or the URL of an object store, for argparse."""
    if "://" in word and not word.startswith("s3://"):
        raise argparse.ArgumentTypeError(f"{word}: a folder or s3://BUCKET/PREFIX")
    return word if "://" in word else Path(word)


def refuse_mismatch(engine: str, address: str | None, store: Path | str, on_gpu: bool) -> None:
    """Raises UserError for options that do not go together."""
    if address is not None and engine != "ray":
        raise UserError("--address is that of a Ray cluster: add --engine ray")
    if engine == "ray" and on_gpu:
        raise UserError("--engine ray trains on CPUs, one run a core: leave out --device")
    if isinstance(store, str) and engine == "slurm":
        raise UserError(f"--engine slurm needs a folder: --store {store} goes with local and ray")


def open_backend(store: Path | str, trials: list[Trial]) -> AbstractContextManager[Backend]:
    """The storage of the runs. Raises UserError if an object store cannot be reached."""
    if isinstance(store, Path):
        return nullcontext(FolderBackend(Store(store)))
    try:
        return BucketBackend(Bucket.open(store), trials)
    except OSError as error:
        raise UserError(f"{store}: {error}") from error


def open_engine(engine: str, address: str | None, jobs: int | None) -> Engine:
    """The engine that runs the trainings. Raises UserError if there is no such cluster."""
    if engine == "ray":
        return open_ray(address, jobs)
    return LocalEngine(jobs or len(os.sched_getaffinity(0)))
