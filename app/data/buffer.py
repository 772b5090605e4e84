"""Replay buffers: the rows of a run with their weights, and what the run's model makes of them.

Pure functions of rows first, then what is read from a run's folder, cached until its files change.
"""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from app.data.cache import VersionedCache, cached
from app.data.readers import reader
from tom.analysis.imagine import step_errors, stored_model, stored_step
from tom.analysis.weighing import load_policy
from tom.data.transitions import Transitions, episodes
from tom.envs import ROAD, Task
from tom.errors import UserError
from tom.policy.stored import StoredPolicy
from tom.record.reader import Recorded, RunReader
from tom.record.store import Store
from tom.record.task_record import scene_of, task_of

Floats = NDArray[np.float64]

WINDOW = 12
"""steps shown before and after a transition"""


@dataclass(frozen=True)
class Rows:
    """N transitions, oldest first, with their weights and other properties."""

    first: int  # the oldest row's number in the run's record
    rows: Transitions  # numpy arrays
    version: NDArray[np.int64]  # (N,) which policy collected it; 0 is exploration
    episode: NDArray[np.int64]  # (N,) number of its episode
    place: NDArray[np.int64]  # (N,) steps since its episode began
    episode_return: Floats  # (N,) of its episode; of a cut episode up to the cut
    weight: Floats  # (N,) mean 1

    def __len__(self) -> int:
        return len(self.weight)

    @property
    def age(self) -> Floats:
        """Position (N,) in the buffer in %, 0 the oldest."""
        return (np.arange(len(self)) + 0.5) * 100 / max(len(self), 1)

    @property
    def policies_known(self) -> bool:
        """Whether the policy of each row is known; else each has a version of its own."""
        return len(np.unique(self.version)) < max(len(self), 2)


def rows_at(
    recorded: Transitions, version: NDArray[np.int64], weight: NDArray, end: int
) -> Rows | None:
    """The rows of `weight` (N,): the N rows before row `end` of the record.

    None if some of them are missing in the record.
    """
    first = end - len(weight)
    if first < 0 or end > len(recorded) or not len(weight):
        return None
    whole = recorded.numpy()
    episode, place, returns = episodes(whole)
    kept = slice(first, end)
    return Rows(
        first, whole[kept], version[kept], episode[kept], place[kept], returns[kept],
        np.asarray(weight, np.float64),
    )  # fmt: skip


@dataclass(frozen=True)
class Against:
    """Weights against a quantity: B groups of about equal size, ascending in the quantity."""

    x: Floats  # (B,) mean of the quantity
    mean: Floats  # (B,) mean weight
    high: Floats  # (B,) 90 % quantile of the weights


def against(quantity: NDArray, weight: NDArray, groups: int = 30) -> Against:
    """The weights (N,) in groups of rows sorted by a quantity (N,); equal values stay together."""
    quantity, weight = np.asarray(quantity, np.float64), np.asarray(weight, np.float64)
    edges = np.unique(np.quantile(quantity, np.linspace(0, 1, groups + 1)))
    cell = np.clip(np.searchsorted(edges, quantity, "right") - 1, 0, max(len(edges) - 2, 0))
    parts = [np.flatnonzero(cell == c) for c in np.unique(cell)]
    return Against(
        np.array([quantity[part].mean() for part in parts]),
        np.array([weight[part].mean() for part in parts]),
        np.array([np.quantile(weight[part], 0.9) for part in parts]),
    )


def windows(ended: NDArray[np.bool_], rows: Sequence[int]) -> NDArray[np.int64]:
    """The row numbers (R, 2 WINDOW + 1) around each of R rows, clamped to its episode."""
    last = np.flatnonzero(ended)
    numbers = []
    for row in rows:
        before = last[last < row]
        after = last[last >= row]
        low = int(before[-1]) + 1 if len(before) else 0
        high = int(after[0]) if len(after) else len(ended) - 1
        numbers.append(np.clip(np.arange(row - WINDOW, row + WINDOW + 1), low, high))
    return np.array(numbers, np.int64).reshape(len(rows), 2 * WINDOW + 1)


ERROR_ROWS = 20_000
"""maximum number of rows for model errors, spread evenly over the buffer"""
SHARED_ROWS = 5000
"""the same for the models of several runs on one buffer"""


def has_rows(run: RunReader) -> bool:
    """Whether the run has a recorded buffer, which may be damaged. Reads no file."""
    return run.version("buffer") != ()


@cached("buffer")
def length(run: RunReader) -> int:
    """The number of rows of a run's recorded buffer, all that were ever collected."""
    return reader(run).buffer_length()


@cached("buffer")
def recorded(run: RunReader) -> Recorded:
    """A run's whole buffer: the only place of this process that reads it."""
    return reader(run).recorded()


@cached("buffer", "snapshot")
def rows(run: RunReader, step: int) -> Rows | None:
    """The replay buffer at the fit of `step`, with that fit's weights; None if it is damaged."""
    weight = reader(run).snapshot(step)["weight"].to_numpy()
    # Offline data is complete from the first step on; online, each step adds a row.
    return weighed_rows(run, weight, len(recorded(run).rows) if run.env == ROAD else step)


def weighed_rows(run: RunReader, weight: NDArray, end: int) -> Rows | None:
    """The N recorded rows before row `end`, with weights (N,); None if some are missing."""
    return rows_at(recorded(run).rows, recorded(run).version, weight, end)


def moments(run: RunReader, rows: Sequence[int]) -> Floats:
    """Observations (R, 2 WINDOW + 1, O) around the recorded rows with these numbers."""
    whole = recorded(run).rows
    return np.asarray(whole.obs, np.float64)[windows(whole.ended(), rows)]


def described_task(run: RunReader) -> Task | None:
    """The run's task; None if its folder does not say what it is."""
    try:
        return task_of(run)
    except UserError:
        return None


def described(run: RunReader) -> tuple[str, ...]:
    """The recorded names of the run's observation dimensions; empty if there are none."""
    known = None if run.env == ROAD else described_task(run)
    return () if known is None else known.obs_names


def drawn(run: RunReader) -> bool:
    """Whether there is a robot to draw in the states of the run's buffer."""
    known = None if scene_of(run) is None else described_task(run)
    return known is not None and (known.root_dims is not None or bool(recorded(run).state))


@cached("buffer", "snapshot", "model")
def model_errors(run: RunReader, step: int) -> tuple[NDArray[np.int64], Floats, int] | str:
    """Row numbers (K,) of `rows(run, step)`, the stored model's errors (K,), the model's step.

    A text with the reason if there is no model.
    """
    weighed = rows(run, step)
    if weighed is None:
        return "its buffer cannot be read"
    try:
        kept = stored_model(run)
    except UserError as error:
        return str(error)
    index = _evenly(len(weighed), ERROR_ROWS)
    return index, step_errors(kept.predictor, weighed.rows[index]).astype(np.float64), kept.env_step


def has_model(run: RunReader) -> bool:
    """Whether the run has a stored model, which may be damaged."""
    return stored_step(run) is not None


def model_errors_of(run: RunReader, index: NDArray[np.int64]) -> Floats:
    """The stored model's error on recorded rows, (N,) of the record: NaN for all others."""
    whole = recorded(run).rows
    errors = np.full(len(whole), np.nan)
    with suppress(UserError):  # the page says what is damaged
        errors[index] = step_errors(stored_model(run).predictor, whole[index])
    return errors


def last_policy(run: RunReader) -> StoredPolicy | None:
    """The policy that a run ended with; None if there is none that can be read."""
    known = described_task(run)
    try:
        found = None if known is None else load_policy(str(run.path), Store(run.path.parent), known)
    except UserError:
        return None
    return found if isinstance(found, StoredPolicy) else None


def policy_distances(run: RunReader) -> Floats:
    """The distance (N,) from each recorded action to the mean action of the run's last policy.

    Root mean square over the action's dimensions; actions are in [-1, 1].
    """
    rows, policy = recorded(run).rows.torch(), last_policy(run)
    if policy is None:
        return np.full(len(rows), np.nan)
    return policy.distances(rows).numpy().astype(np.float64)


def errors_on(run: RunReader, other: RunReader) -> Floats | None:
    """Error (K,) of `other`'s stored model on rows spread evenly over `run`'s buffer.

    None if `other` has no stored model.
    """
    if stored_step(other) is None:
        return None

    def read() -> Floats | None:
        whole = recorded(run).rows
        if not len(whole):
            return None
        try:
            kept = stored_model(other)
        except UserError:
            return None
        part = whole[_evenly(len(whole), SHARED_ROWS)]
        return step_errors(kept.predictor, part).astype(np.float64)

    version = run.version("buffer"), other.version("model")
    return _ERRORS_ON.get((run.path, other.path), read, version)


_ERRORS_ON: VersionedCache[Floats | None] = VersionedCache()


def _evenly(count: int, most: int) -> NDArray[np.int64]:
    return np.unique(np.linspace(0, count - 1, most).astype(np.int64))
