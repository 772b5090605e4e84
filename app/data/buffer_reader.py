"""Replay buffers for the pages, cached until their files change."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from app.data import readers, regions
from app.data.buffer import Floats, Rows, rows_at, windows
from app.data.cache import VersionedCache
from app.data.readers import RunInfo
from app.data.regions import Plane
from tom.analysis.imagine import step_errors, stored_model, stored_step
from tom.data.transitions import Transitions
from tom.envs import ROAD, Task
from tom.errors import UserError
from tom.record import stamps
from tom.record.task_record import scene_of, task_of

ERROR_ROWS = 20_000
"""maximum number of rows for model errors, spread evenly over the buffer"""
SHARED_ROWS = 5000
"""the same for the models of several runs on one buffer"""


def fits(run: RunInfo) -> list[int]:
    """The model fits of a run whose single weights were stored."""
    return readers.reader(run).snapshot_steps()


def rows(run: RunInfo, step: int) -> Rows | None:
    """The replay buffer at the fit of `step`, with that fit's weights; None if it is damaged."""
    recorded = _recorded(run)

    def read() -> Rows | None:
        weight = readers.reader(run).snapshot(step)["weight"].to_numpy()
        # Offline data is complete from the first step on; online, each step adds a row.
        end = len(recorded.rows) if run.env == ROAD else step
        return rows_at(recorded.rows, recorded.version, weight, end)

    version = stamps.buffer(run.folder), stamps.snapshot(run.folder, step)
    return _AT_FITS.get((run.path, step), read, version)


def described(run: RunInfo) -> tuple[str, ...]:
    """The recorded names of the run's observation dimensions; empty if there are none."""
    known = None if run.env == ROAD else described_task(run)
    return () if known is None else known.obs_names


def described_task(run: RunInfo) -> Task | None:
    """The run's task; None if its folder does not say what it is."""
    try:
        return task_of(readers.reader(run))
    except UserError:
        return None


def drawn(run: RunInfo) -> bool:
    """Whether there is a robot to draw in the states of the run's buffer."""
    reader = readers.reader(run)
    known = None if scene_of(reader) is None else described_task(run)
    return known is not None and (known.root_dims is not None or bool(reader.buffer_state()))


def moments(run: RunInfo, rows: Sequence[int]) -> Floats:
    """Observations (R, 2 WINDOW + 1, O) around the recorded rows with these numbers."""
    recorded = _recorded(run).rows.numpy()
    return np.asarray(recorded.obs, np.float64)[windows(recorded.ended(), rows)]


def weighed_rows(run: RunInfo, weight: NDArray, end: int) -> Rows | None:
    """The N recorded rows before row `end`, with weights (N,); None if some are missing."""
    recorded = _recorded(run)
    return rows_at(recorded.rows, recorded.version, weight, end)


def model_errors(run: RunInfo, step: int) -> tuple[NDArray[np.int64], Floats, int] | str:
    """Row numbers (K,) of `rows(run, step)`, the stored model's errors (K,), the model's step.

    A text with the reason if there is no model.
    """
    folder = run.folder
    version = stamps.buffer(folder), stamps.snapshot(folder, step), stamps.model(folder)
    return _ERRORS.get((run.path, step), lambda: _errors(run, step), version)


def errors_on(run: RunInfo, other: RunInfo) -> Floats | None:
    """Error (K,) of `other`'s stored model on rows spread evenly over `run`'s buffer.

    None if `other` has no stored model.
    """
    if stored_step(readers.reader(other)) is None:
        return None
    version = stamps.buffer(run.folder), stamps.model(other.folder)
    return _ERRORS_ON.get((run.path, other.path), lambda: _errors_on(run, other), version)


def principal_plane(run: RunInfo, rows: Rows) -> Plane:
    """The principal components of some of a run's rows."""
    version = stamps.buffer(run.folder), rows.first, len(rows)
    return _PLANES.get(run.path, lambda: regions.principal_plane(rows.rows), version)


def has_rows(run: RunInfo) -> bool:
    """Whether the run has a recorded buffer, which may be damaged. Reads no file."""
    return stamps.buffer(run.folder) != ()


def length(run: RunInfo) -> int:
    """The number of rows of a run's recorded buffer, all that were ever collected."""
    version = stamps.buffer(run.folder)
    return _LENGTHS.get(run.path, readers.reader(run).buffer_length, version)


@dataclass(frozen=True)
class _Recorded:
    """A run's current buffer, with the policy version of each row."""

    rows: Transitions
    version: NDArray[np.int64]


_RECORDED: VersionedCache[_Recorded] = VersionedCache()
_AT_FITS: VersionedCache[Rows | None] = VersionedCache()
_PLANES: VersionedCache[Plane] = VersionedCache()
_LENGTHS: VersionedCache[int] = VersionedCache()
_ERRORS: VersionedCache[tuple[NDArray[np.int64], Floats, int] | str] = VersionedCache()
_ERRORS_ON: VersionedCache[Floats | None] = VersionedCache()


def _recorded(run: RunInfo) -> _Recorded:
    version = stamps.buffer(run.folder)
    return _RECORDED.get(run.path, lambda: _Recorded(*readers.reader(run).buffer()), version)


def _errors(run: RunInfo, step: int) -> tuple[NDArray[np.int64], Floats, int] | str:
    weighed = rows(run, step)
    if weighed is None:
        return "its buffer cannot be read"
    try:
        kept = stored_model(readers.reader(run))
    except UserError as error:
        return str(error)
    index = np.unique(np.linspace(0, len(weighed) - 1, ERROR_ROWS).astype(np.int64))
    error = step_errors(kept.predictor, weighed.rows[index]).astype(np.float64)
    return index, error, kept.env_step


def _errors_on(run: RunInfo, other: RunInfo) -> Floats | None:
    recorded = _recorded(run).rows
    if not len(recorded):
        return None
    try:
        kept = stored_model(readers.reader(other))
    except UserError:
        return None
    part = recorded[np.unique(np.linspace(0, len(recorded) - 1, SHARED_ROWS).astype(np.int64))]
    return step_errors(kept.predictor, part).astype(np.float64)
