"""Replay buffers for the pages: read once, read again when their files have changed."""

import zipfile
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import streamlit as st
from numpy.typing import NDArray

from app.data import pictures, readers, regions
from app.data.buffer import Floats, Rows, rows_at
from app.data.cache import VersionedCache
from app.data.readers import RunInfo, Stamp
from app.data.regions import Plane
from tom.analysis.imagine import (
    Stamps,
    StoredModel,
    step_errors,
    stored_model,
    stored_stamps,
    stored_step,
)
from tom.data.transitions import Transitions
from tom.errors import UserError
from tom.record import layout
from tom.record.reader import RunReader

ERROR_ROWS = 20_000
"""rows at most whose model error is computed: they are spread evenly over the buffer"""
SHARED_ROWS = 5000
"""the same where several runs' models are asked about one buffer"""


def fits(run: RunInfo) -> list[int]:
    """The model fits of a run whose every single weight was kept."""
    return RunReader(run.path).snapshot_steps()


def rows(run: RunInfo, step: int) -> Rows | None:
    """The replay buffer at the fit of `step`, with that fit's weights; None where it is damaged."""
    return _rows(run.path, run.env, step, _stamp(run), readers.stamp(_snapshot(run, step)))


def weighed_rows(run: RunInfo, weight: NDArray, end: int) -> Rows | None:
    """The N recorded rows before row `end`, with weights (N,); None where some are lost."""
    recorded = _recorded(run.path, _stamp(run))
    return rows_at(recorded.rows, recorded.version, weight, end)


def model_errors(run: RunInfo, step: int) -> tuple[NDArray[np.int64], Floats, int] | str:
    """Row numbers (K,) of `rows(run, step)`, the kept model's error there (K,), the model's step.

    The reason in words where there is no model.
    """
    weighed, model = readers.stamp(_snapshot(run, step)), stored_stamps(RunReader(run.path))
    return _errors(run.path, run.env, step, _stamp(run), weighed, model)


def errors_on(run: RunInfo, other: RunInfo) -> Floats | None:
    """Error (K,) of `other`'s kept model on rows spread evenly over `run`'s buffer.

    None where `other` kept no model.
    """
    reader = RunReader(other.path)
    if stored_step(reader) is None:
        return None
    return _errors_on(run.path, _stamp(run), other.path, stored_stamps(reader))


def principal_plane(run: RunInfo, rows: Rows) -> Plane:
    """The principal components of some of a run's rows."""
    planes = _recorded(run.path, _stamp(run)).planes
    return planes.get((rows.first, len(rows)), lambda: regions.principal_plane(rows.rows))


def has_rows(run: RunInfo) -> bool:
    """The run has recorded a buffer, which may be damaged. Reads nothing."""
    return _stamp(run) != (0, 0)


def length(run: RunInfo) -> int:
    """Rows of a run's recorded buffer, all that were ever collected."""
    return _length(run.path, _stamp(run))


def _snapshot(run: RunInfo, step: int) -> Path:
    return Path(run.path) / layout.snapshot(step)


def _stamp(run: RunInfo) -> Stamp:
    """Changes whenever the buffer's files do."""
    folder = Path(run.path) / "buffer"
    last = layout.numbers(folder, ".npz")[-1:]
    return readers.stamp(Path(run.path) / layout.segment(last[0])) if last else (0, 0)


@dataclass(frozen=True)
class _Recorded:
    """A run's buffer as it is now, and what was made of it: when it changes, all of it goes."""

    rows: Transitions
    version: NDArray[np.int64]
    at_fits: VersionedCache[Rows | None] = field(default_factory=lambda: VersionedCache(4))
    planes: VersionedCache[Plane] = field(default_factory=lambda: VersionedCache(2))


_RECORDED: VersionedCache[_Recorded] = VersionedCache(4)


def _recorded(path: str, changed: Stamp) -> _Recorded:
    return _RECORDED.get(path, lambda: _Recorded(*RunReader(path).buffer()), changed)


@st.cache_data(show_spinner=False, max_entries=512)
def _length(path: str, changed: Stamp) -> int:
    folder = Path(path) / "buffer"
    last = layout.numbers(folder, ".npz")[-1:]
    try:
        with np.load(Path(path) / layout.segment(last[0]), allow_pickle=False) as file:
            return last[0] + len(file["reward"])
    except (IndexError, OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return 0


@st.cache_data(show_spinner=False, max_entries=128)
def _errors_on(path: str, changed: Stamp, other: str, model: Stamps) -> Floats | None:
    recorded = _recorded(path, changed).rows
    if not len(recorded):
        return None
    try:
        kept = stored_model(RunReader(other))
    except UserError:
        return None
    part = recorded[np.unique(np.linspace(0, len(recorded) - 1, SHARED_ROWS).astype(np.int64))]
    return _one_step(kept, part)


def _rows(path: str, env: str, step: int, changed: Stamp, weighed: Stamp) -> Rows | None:
    recorded = _recorded(path, changed)

    def read() -> Rows | None:
        weight = RunReader(path).snapshot(step)["weight"].to_numpy()
        # Offline data are all there from the first step on; online, a step adds a row.
        end = len(recorded.rows) if env == pictures.ENV else step
        return rows_at(recorded.rows, recorded.version, weight, end)

    return recorded.at_fits.get(step, read, weighed)


@st.cache_resource(show_spinner=False, max_entries=16)
def _errors(
    path: str, env: str, step: int, changed: Stamp, weighed: Stamp, model: Stamps
) -> tuple[NDArray[np.int64], Floats, int] | str:
    found = _rows(path, env, step, changed, weighed)
    if found is None:
        return "its buffer cannot be read"
    try:
        kept = stored_model(RunReader(path))
    except UserError as error:
        return str(error)
    index = np.unique(np.linspace(0, len(found) - 1, ERROR_ROWS).astype(np.int64))
    return index, _one_step(kept, found.rows[index]), kept.env_step


def _one_step(kept: StoredModel, rows: Transitions) -> Floats:
    part = rows.numpy()
    parts = (np.asarray(x) for x in (part.obs, part.action, part.next_obs))
    return step_errors(kept.predictor, *parts).astype(np.float64)
