"""Run folders for the pages, cached until a file changes."""

import os
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from app.data import trainings
from app.data.cache import cached, get_or_make
from tom.analysis.weight_readers import first_weight_reader
from tom.errors import UserError
from tom.record import manage
from tom.record.decode import Profiles
from tom.record.reader import RunReader, Version
from tom.record.status import DEAD_AFTER_S
from tom.record.store import Store


@dataclass(frozen=True)
class Listing:
    """The runs of a store, newest first, and its unreadable folders."""

    runs: tuple[RunReader, ...]
    problems: tuple[str, ...]


# Without a bound, because every page needs the information on every run of the store.
_RUNS: dict[str, dict[str, tuple[object, RunReader]]] = {}


def listing(store: str) -> Listing:
    """Every run of `store`; a store that cannot be read is a problem, not an error.

    The runs are shared and made anew when their files change. Their `problems` are those of
    configuration, status and labels: parts are read by functions here or by `reader`.
    """
    try:
        names = Store(store).names()
    except UserError as error:
        return Listing((), (str(error),))
    known, current = _RUNS.get(store, {}), {}
    runs: list[RunReader] = []
    problems: list[str] = []
    for name in names:
        found = known.get(name)
        if found is None or found[0] != _version(found[1]):
            version = _version(RunReader(Path(store) / name))
            try:
                run = Store(store).open_run(name)
            except UserError as error:
                problems.append(str(error))
                continue
            _ = run.status, run.labels  # read them, for their problems
            found = version, run
        current[name] = found
        runs.append(_with_current_status(found[1]))
    _RUNS[store] = current
    runs.sort(key=lambda run: (run.created, run.run_id), reverse=True)
    return Listing(tuple(runs), tuple(problems))


def _version(run: RunReader) -> object:
    return os.path.islink(run.path), run.version("facts")  # noqa: PTH114 (pathlib's takes longer)


def _with_current_status(run: RunReader) -> RunReader:
    """The run, shown as dead at once if its process has ended without a final status."""
    if not (run.status.alive and trainings.has_ended(run.path)):
        return run
    last = min(run.status.heartbeat, time.time() - DEAD_AFTER_S - 1)
    reason = run.status.reason or "its process has ended without a word"
    return run.with_status(replace(run.status, heartbeat=last, reason=reason))


def trashed(store: Path | str) -> list[str]:
    """The ids of the runs in the trash; none if this user may not look into it, or it is a link."""
    try:
        return manage.trashed(Store(store))
    except (OSError, UserError):
        return []


def folder_reader(folder: Path | str) -> RunReader:
    """The run in a folder, or the data set."""
    return RunReader(folder)


def fresh_reader(run: RunReader) -> RunReader:
    """Another reader of the run's folder, with problems of its own."""
    return RunReader(run.path)


def _part(run: RunReader, part: Literal["metrics", "profiles", "notices"]) -> tuple[Any, list[str]]:
    """A part of a run, and the problems of its files."""

    def read() -> tuple[Any, list[str]]:
        own = fresh_reader(run)
        return getattr(own, part)(), own.problems

    return get_or_make((part, run.path), run.version(part), read)


def metrics(run: RunReader) -> pd.DataFrame:
    """One row per recorded step: `env_step` and every metric; of a loop also its live weights'."""
    own, live = _part(run, "metrics")[0], first_weight_reader(run)
    if live is run:
        return own
    found = _part(live, "metrics")[0]
    more = [name for name in found if name == "env_step" or name not in own]
    return own.merge(found[more], "outer", "env_step")


def metrics_version(run: RunReader) -> tuple[Version, Version]:
    """A value that changes whenever `metrics` does. Reads no metrics."""
    return run.version("metrics"), first_weight_reader(run).version("metrics")


def profiles(run: RunReader) -> Profiles:
    """The weight profile of every model fit."""
    return _part(run, "profiles")[0]


def notices(run: RunReader) -> list[dict[str, Any]]:
    """The notices of the run: `env_step`, `kind`, `message`."""
    return _part(run, "notices")[0]


def metrics_problems(run: RunReader) -> list[str]:
    """Damaged or missing parts of a run that its curves need."""
    return list(dict.fromkeys([*run.problems, *_part(run, "metrics")[1]]))


def problems(run: RunReader) -> list[str]:
    """Damaged or missing parts of a run that the pages of a single run need."""
    named = [*metrics_problems(run), *_part(run, "profiles")[1], *_part(run, "notices")[1]]
    return list(dict.fromkeys(named))


def metric_counts(run: RunReader) -> dict[str, int]:
    """The number of recorded values of each metric that has at least one."""
    return _metric_counts(first_weight_reader(run)) | _metric_counts(run)


@cached("metrics")
def _metric_counts(run: RunReader) -> dict[str, int]:
    frame = _part(run, "metrics")[0]
    count = np.isfinite(frame.to_numpy(np.float64)).sum(0)
    return {str(name): int(n) for name, n in zip(frame, count, strict=True) if n}


@cached("recordings")
def recordings(run: RunReader) -> list[str]:
    """The names of the run's Rerun recordings, in the order they were written."""
    return [path.name for path in run.rrd_files()]


@cached("episodes")
def returns(run: RunReader, step: int) -> NDArray[np.float64]:
    """The return of each episode of the evaluation at `step`; empty if unreadable."""
    return np.array([e.undiscounted_return for e in fresh_reader(run).episodes(step)], np.float64)
