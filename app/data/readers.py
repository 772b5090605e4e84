"""Run folders for the pages: read once, read again when a file changes."""

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import numpy as np
import pandas as pd

from app.data import pictures, trainings
from app.data.cache import VersionedCache
from app.data.pictures import Picture
from app.data.settings import Settings, in_words
from tom.errors import UserError
from tom.record import layout, small_copy
from tom.record.labels import Labels
from tom.record.profiles import Profiles
from tom.record.reader import RunReader
from tom.record.status import DEAD_AFTER_S, Status
from tom.record.store import Store

T = TypeVar("T")

Stamp = tuple[int, int]
"""(mtime_ns, size) of a file: what a cached read depends on."""


@dataclass(frozen=True)
class RunInfo:
    """What a page knows about a run without reading its tables."""

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
    """the whole configuration: path to words"""
    small_copy: bool
    left_out: tuple[str, ...]
    """what a small copy has not, of what its run had"""

    @property
    def shown(self) -> str:
        """The state in words, as `RunReader.shown` has it."""
        return small_copy.shown(self.status, self.small_copy)

    @property
    def name(self) -> str:
        """What people call it; its id where they gave it no name."""
        return self.labels.name or self.run_id


@dataclass(frozen=True)
class Listing:
    """The runs of a store, newest first, and what in it could not be read."""

    runs: tuple[RunInfo, ...]
    problems: tuple[str, ...]


def listing(store: str) -> Listing:
    """Every run of `store`; a store that cannot be read is a problem, not an error."""
    try:
        names = Store(store).names()
    except UserError as error:
        return Listing((), (str(error),))
    runs: list[RunInfo] = []
    problems: list[str] = []
    for name in names:
        try:
            runs.append(_as_it_is(_info(store, name)))
        except UserError as error:
            problems.append(str(error))
    runs.sort(key=lambda run: (run.created, run.run_id), reverse=True)
    return Listing(tuple(runs), tuple(problems))


def metrics(run: RunInfo) -> pd.DataFrame:
    """A row a recorded step: `env_step` and every metric."""
    return _metrics(run)[0]


def points(run: RunInfo) -> dict[str, int]:
    """How many values of each metric the run has recorded, of those with one at least."""
    return _POINTS.get(run.path, lambda: _count(metrics(run)), recorded(run))


def recorded(run: RunInfo) -> tuple[Stamp, ...]:
    """Changes whenever a metric of the run does."""
    return _stamps(run, layout.METRICS, layout.METRICS_TABLE)


def has_profiles(run: RunInfo) -> bool:
    """A model fit has left a profile, which may be damaged. Reads nothing."""
    return _stamps(run, layout.PROFILES)[0][1] > 0


def profiles(run: RunInfo) -> Profiles:
    """The weight profile of every model fit."""
    return _profiles(run)[0]


def notices(run: RunInfo) -> list[dict]:
    """What the run itself warned of: `env_step`, `kind`, `message`."""
    return _notices(run)[0]


def metrics_problems(run: RunInfo) -> list[str]:
    """What is damaged or missing in the parts of a run that make its curves."""
    return list(dict.fromkeys([*run.problems, *_metrics(run)[1]]))


def problems(run: RunInfo) -> list[str]:
    """What is damaged or missing in the parts of a run that the pages of one run read."""
    found = [*metrics_problems(run), *_profiles(run)[1], *_notices(run)[1]]
    return list(dict.fromkeys(found))


def road_steps(run: RunInfo) -> list[int]:
    """The fits of a road-and-rocks run that can be drawn on its map."""
    return pictures.steps(RunReader(run.path))


def road_picture(run: RunInfo, step: int) -> Picture | None:
    """One fit of a road-and-rocks run; None when its map cannot be read."""
    changed = stamp(Path(run.path) / layout.snapshot(step))
    return _ROAD_PICTURES.get(
        (run.path, step), lambda: pictures.load(RunReader(run.path), step), changed
    )


def recordings(run: RunInfo) -> list[str]:
    """The names of the run's Rerun recordings, in the order they were written."""
    return [path.name for path in RunReader(run.path).rrd_files()]


def stamp(path: Path) -> Stamp:
    """Changes whenever the file does; (0, 0) while there is none."""
    try:
        found = path.stat()
    except OSError:
        return (0, 0)
    return (found.st_mtime_ns, found.st_size)


def _as_it_is(run: RunInfo) -> RunInfo:
    """A run whose process has ended without a word is dead at once, not when its beat is missed."""
    if not (run.status.alive and trainings.gone(Path(run.path))):
        return run
    last = min(run.status.heartbeat, time.time() - DEAD_AFTER_S - 1)
    words = run.status.reason or "its process has ended without a word"
    return replace(run, status=replace(run.status, heartbeat=last, reason=words))


# What is read is shared, not copied, as no page changes it. Streamlit's own caches take 0.3 ms to
# find what they hold, which 200 runs notice.


_INFOS: VersionedCache[RunInfo] = VersionedCache(4096)
_METRICS: VersionedCache[tuple[pd.DataFrame, list[str]]] = VersionedCache(1024)
_POINTS: VersionedCache[dict[str, int]] = VersionedCache(1024)
_PROFILES: VersionedCache[tuple[Profiles, list[str]]] = VersionedCache(1024)
_NOTICES: VersionedCache[tuple[list[dict], list[str]]] = VersionedCache(1024)
_ROAD_PICTURES: VersionedCache[Picture | None] = VersionedCache(64)


def _info(store: str, name: str) -> RunInfo:
    """Raises UserError, which is not kept, where there is no run."""
    path = Path(store) / name
    stamps = [stamp(path / part) for part in (layout.CONFIG, layout.STATUS, layout.LABELS)]
    version = path.is_symlink(), *stamps
    return _INFOS.get(path, lambda: _read_info(store, name), version)


def _read_info(store: str, name: str) -> RunInfo:
    reader = Store(store).look(name)
    return RunInfo(
        path=str(reader.path),
        run_id=reader.run_id,
        env=reader.env,
        learner=reader.learner,
        seed=reader.seed,
        preset=str(reader.config.get("preset", "?")),
        created=reader.created,
        status=reader.status,
        labels=reader.labels,
        settings=in_words(reader.config.get("config")),
        small_copy=reader.small_copy,
        left_out=reader.left_out,
        problems=tuple(reader.problems),
    )


def _metrics(run: RunInfo) -> tuple[pd.DataFrame, list[str]]:
    return _read(_METRICS, run, RunReader.metrics, recorded(run))


def _profiles(run: RunInfo) -> tuple[Profiles, list[str]]:
    return _read(_PROFILES, run, RunReader.profiles, _stamps(run, layout.PROFILES))


def _notices(run: RunInfo) -> tuple[list[dict], list[str]]:
    return _read(_NOTICES, run, RunReader.notices, _stamps(run, layout.NOTICES))


def _read(
    cache: VersionedCache[tuple[T, list[str]]],
    run: RunInfo,
    read: Callable[[RunReader], T],
    version: tuple[Stamp, ...],
) -> tuple[T, list[str]]:
    """A part of a run and what is damaged in it, from `cache` where its files are in `version`."""

    def make() -> tuple[T, list[str]]:
        reader = RunReader(run.path)
        return read(reader), reader.problems

    return cache.get(run.path, make, version)


def _count(frame: pd.DataFrame) -> dict[str, int]:
    count = np.isfinite(frame.to_numpy(np.float64)).sum(0)
    return {str(name): int(n) for name, n in zip(frame, count, strict=True) if n}


def _stamps(run: RunInfo, *names: str) -> tuple[Stamp, ...]:
    folder = Path(run.path)
    return tuple(stamp(folder / name) for name in names)
