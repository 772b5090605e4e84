"""Run folders for the pages, cached until a file changes."""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from app.data import pictures, trainings
from app.data.cache import VersionedCache
from app.data.pictures import Picture
from tom.config import Settings
from tom.errors import UserError
from tom.record import manage, small_copy, stamps
from tom.record.decode import Profiles
from tom.record.labels import Labels
from tom.record.reader import RunReader
from tom.record.stamps import Stamp
from tom.record.status import DEAD_AFTER_S, Status
from tom.record.store import Store

T = TypeVar("T")


@dataclass(frozen=True)
class RunInfo:
    """The information on a run that needs none of its tables."""

    path: str
    run_id: str
    env: str
    learner: str
    seed: int
    preset: str
    created: str
    status: Status
    problems: tuple[str, ...]
    labels: Labels
    settings: Settings
    """the whole configuration: path to text"""
    small_copy: bool
    left_out: tuple[str, ...]
    """the parts of the run that a small copy lacks"""

    @property
    def folder(self) -> Path:
        return Path(self.path)

    @property
    def shown(self) -> str:
        """The state in words, as in `RunReader.shown`."""
        return small_copy.shown(self.status, self.small_copy)

    @property
    def name(self) -> str:
        """The user's name of the run, else its id."""
        return self.labels.name or self.run_id


@dataclass(frozen=True)
class Listing:
    """The runs of a store, newest first, and its unreadable folders."""

    runs: tuple[RunInfo, ...]
    problems: tuple[str, ...]


def listing(store: str) -> Listing:
    """Every run of `store`; a store that cannot be read is a problem, not an error."""
    try:
        names = Store(store).names()
    except UserError as error:
        return Listing((), (str(error),))
    known, current = _INFOS.get(store, {}), {}
    runs: list[RunInfo] = []
    problems: list[str] = []
    for name in names:
        folder = Path(store) / name
        version = folder.is_symlink(), stamps.about(folder)
        if name not in known or known[name][0] != version:
            try:
                current[name] = version, _read_info(store, name)
            except UserError as error:
                problems.append(str(error))
                continue
        else:
            current[name] = known[name]
        runs.append(_as_it_is(current[name][1]))
    _INFOS[store] = current
    runs.sort(key=lambda run: (run.created, run.run_id), reverse=True)
    return Listing(tuple(runs), tuple(problems))


def trashed(store: Path | str) -> list[str]:
    """The ids of the runs in the trash; none if this user may not look into it, or it is a link."""
    try:
        return manage.trashed(Store(store))
    except (OSError, UserError):
        return []


def metrics(run: RunInfo) -> pd.DataFrame:
    """One row per recorded step: `env_step` and every metric."""
    return _metrics(run)[0]


def points(run: RunInfo) -> dict[str, int]:
    """The number of recorded values of each metric that has at least one."""
    return _POINTS.get(run.path, lambda: _count(metrics(run)), recorded(run))


def recorded(run: RunInfo) -> Stamp:
    """A stamp that changes whenever a metric of the run changes."""
    return stamps.metrics(run.folder)


def has_profiles(run: RunInfo) -> bool:
    """Whether there is a profile, which may be damaged. Reads no file."""
    return stamps.profiles(run.folder)[0][1] > 0


def profiles(run: RunInfo) -> Profiles:
    """The weight profile of every model fit."""
    return _profiles(run)[0]


def notices(run: RunInfo) -> list[dict]:
    """The notices of the run: `env_step`, `kind`, `message`."""
    return _notices(run)[0]


def metrics_problems(run: RunInfo) -> list[str]:
    """Damaged or missing parts of a run that its curves need."""
    return list(dict.fromkeys([*run.problems, *_metrics(run)[1]]))


def problems(run: RunInfo) -> list[str]:
    """Damaged or missing parts of a run that the pages of a single run need."""
    named = [*metrics_problems(run), *_profiles(run)[1], *_notices(run)[1]]
    return list(dict.fromkeys(named))


def road_steps(run: RunInfo) -> list[int]:
    """The fits of a road-and-rocks run that can be drawn on its map."""
    return pictures.steps(reader(run))


def road_picture(run: RunInfo, step: int) -> Picture | None:
    """One fit of a road-and-rocks run; None if its map cannot be read."""
    return pictures.load(reader(run), step)


def recordings(run: RunInfo) -> list[str]:
    """The names of the run's Rerun recordings, in the order they were written."""
    version = stamps.stamp(run.folder)  # fast, because pages need it for every run
    return _RECORDINGS.get(run.path, lambda: [p.name for p in reader(run).rrd_files()], version)


def evaluation_steps(run: RunInfo) -> list[int]:
    """The evaluations whose episodes were recorded."""
    return reader(run).evaluation_steps()


def returns(run: RunInfo, step: int) -> NDArray[np.float64]:
    """The return of each episode of the evaluation at `step`; empty if unreadable."""

    def make() -> NDArray[np.float64]:
        return np.array([e.undiscounted_return for e in reader(run).episodes(step)], np.float64)

    return _RETURNS.get((run.path, step), make, stamps.episodes(run.folder, step))


def policy_steps(run: RunInfo) -> list[int]:
    """The fits whose policy was stored."""
    return reader(run).policy_steps()


def reader(run: RunInfo) -> RunReader:
    """The reader of the run's folder, for data without a function here."""
    return RunReader(run.path)


def reader_at(path: Path) -> RunReader:
    """The reader of a folder with the layout of a run, such as that of weighed data."""
    return RunReader(path)


def _as_it_is(run: RunInfo) -> RunInfo:
    """The run, shown as dead at once if its process has ended without a final status."""
    if not (run.status.alive and trainings.gone(run.folder)):
        return run
    last = min(run.status.heartbeat, time.time() - DEAD_AFTER_S - 1)
    words = run.status.reason or "its process has ended without a word"
    return replace(run, status=replace(run.status, heartbeat=last, reason=words))


# Results are shared, not copied, because no page changes them. Streamlit's own caches take 0.3 ms
# for a lookup, which matters for 200 runs.


# Without a bound, because every page needs the information on every run of the store.
_INFOS: dict[str, dict[str, tuple[object, RunInfo]]] = {}
_METRICS: VersionedCache[tuple[pd.DataFrame, list[str]]] = VersionedCache()
_POINTS: VersionedCache[dict[str, int]] = VersionedCache()
_PROFILES: VersionedCache[tuple[Profiles, list[str]]] = VersionedCache()
_NOTICES: VersionedCache[tuple[list[dict], list[str]]] = VersionedCache()
_RECORDINGS: VersionedCache[list[str]] = VersionedCache()
_RETURNS: VersionedCache[NDArray[np.float64]] = VersionedCache()


def _read_info(store: str, name: str) -> RunInfo:
    """Raises UserError if there is no run."""
    run = Store(store).look(name)
    return RunInfo(
        path=str(run.path),
        run_id=run.run_id,
        env=run.env,
        learner=run.learner,
        seed=run.seed,
        preset=run.preset,
        created=run.created,
        status=run.status,
        labels=run.labels,
        settings=run.settings,
        small_copy=run.small_copy,
        left_out=run.left_out,
        problems=tuple(run.problems),
    )


def _metrics(run: RunInfo) -> tuple[pd.DataFrame, list[str]]:
    return _read(_METRICS, run, RunReader.metrics, recorded(run))


def _profiles(run: RunInfo) -> tuple[Profiles, list[str]]:
    return _read(_PROFILES, run, RunReader.profiles, stamps.profiles(run.folder))


def _notices(run: RunInfo) -> tuple[list[dict], list[str]]:
    return _read(_NOTICES, run, RunReader.notices, stamps.notices(run.folder))


def _read(
    cache: VersionedCache[tuple[T, list[str]]],
    run: RunInfo,
    read: Callable[[RunReader], T],
    version: Stamp,
) -> tuple[T, list[str]]:
    """A part of a run and its problems, from `cache` if its files have the same `version`."""

    def make() -> tuple[T, list[str]]:
        part = reader(run)
        return read(part), part.problems

    return cache.get(run.path, make, version)


def _count(frame: pd.DataFrame) -> dict[str, int]:
    count = np.isfinite(frame.to_numpy(np.float64)).sum(0)
    return {str(name): int(n) for name, n in zip(frame, count, strict=True) if n}
