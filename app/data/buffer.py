"""Replay buffers: the rows of a run with their weights, and what the run's model makes of them.

Pure functions of rows first, then what is read from a run's folder, cached until its files change.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from app.data.cache import cached
from app.data.readers import fresh_reader
from tom.data.transitions import Transitions, episodes
from tom.envs import ROAD, Task
from tom.errors import UserError
from tom.record import checkpoint
from tom.record.reader import Recorded, RunReader
from tom.record.store import Store
from tom.record.task_record import dimension_names, scene_of, task_of
from tom.spread import spread

if TYPE_CHECKING:  # torch takes seconds to import, and the first page does without it
    from tom.analysis.imagine import StoredModel
    from tom.policy.stored import StoredPolicy

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
    episode_step: NDArray[np.int64]  # (N,) steps since its episode began
    episode_return: Floats  # (N,) of its episode; of a cut episode up to the cut
    weight: Floats  # (N,) mean 1

    def __len__(self) -> int:
        return len(self.weight)


def policies_known(version: NDArray[np.int64]) -> bool:
    """Whether it is known which policies collected N rows; else each has a version of its own."""
    return len(np.unique(version)) < max(len(version), 2)


def heavy_and_light(
    rows: Rows, mask: NDArray[np.bool_], count: int, gap: int
) -> tuple[list[int], list[int]]:
    """The heaviest and the lightest rows of a region, at least `gap` steps apart."""

    def first_of(order: NDArray[np.int64]) -> list[int]:
        picked: list[int] = []
        for row in map(int, order):
            if len(picked) == count:
                break
            if all(abs(row - other) >= gap for other in picked):
                picked.append(row)
        return picked

    # Shuffled: among equal weights, of which there may be many, no part of the buffer is preferred.
    index = np.random.default_rng(0).permutation(np.flatnonzero(mask))
    if not len(index):
        return [], []
    weight = rows.weight[index]
    # Only the ends are sorted: a picked row keeps out fewer than 2 gap others.
    near = min(2 * gap * count, len(index)) - 1
    low, high = np.partition(weight, (near, len(weight) - 1 - near))[[near, ~near]]
    light, heavy = (
        index[end][np.argsort(weight[end], kind="stable")]
        for end in (weight <= low, weight >= high)
    )
    return first_of(heavy[::-1]), first_of(light)


def windows(ended: NDArray[np.bool_], rows: Sequence[int]) -> NDArray[np.int64]:
    """The row numbers (R, 2 WINDOW + 1) around each of R rows, clamped to its episode."""
    last = np.append(np.flatnonzero(ended), len(ended) - 1)
    center = np.array(rows, np.int64)
    episode = np.searchsorted(last, center)
    low, high = np.append(-1, last)[episode] + 1, last[episode]
    around = center[:, None] + np.arange(-WINDOW, WINDOW + 1)
    return np.clip(around, low[:, None], high[:, None])


def poses(
    task: Task, recorded: Transitions, state: dict[str, NDArray], rows: NDArray[np.int64]
) -> NDArray[np.float32]:
    """Joint positions (R, W, nq) of the recorded states at row numbers (R, W).

    Positions on the ground are relative to the middle of each robot's window; without the
    simulator's state a robot stays at the origin.
    """
    if "qpos" in state:
        qpos = state["qpos"][rows].astype(np.float32)
        roots = task.root_dims or 0
        qpos[..., :roots] -= qpos[:, WINDOW : WINDOW + 1, :roots]
        return qpos
    return task.qpos_from_obs(np.asarray(recorded.obs, np.float32)[rows])


SHARED_ROWS = 5000
"""maximum number of rows for the errors of several runs' models on one buffer"""


def has_rows(run: RunReader) -> bool:
    """Whether the run has a recorded buffer, which may be damaged. Reads no file."""
    return run.version("buffer") != ()


@cached("buffer")
def length(run: RunReader) -> int:
    """The number of rows of a run's recorded buffer, all that were ever collected."""
    return fresh_reader(run).buffer_length()


@cached("buffer")
def recorded(run: RunReader) -> Recorded:
    """A run's whole buffer, without the simulator's states and the actions' Gaussians."""
    return fresh_reader(run).recorded(states=False, behaviour=False)


@cached("buffer")
def recorded_with_states(run: RunReader) -> Recorded:
    """A run's whole buffer for a scene of its robots, without the actions' Gaussians."""
    return fresh_reader(run).recorded(behaviour=False)


def weighed_rows(run: RunReader, weight: NDArray, end: int) -> Rows | None:
    """The N recorded rows before row `end`, with weights (N,); None if some are missing."""
    whole, first = recorded(run), end - len(weight)
    if first < 0 or end > len(whole.rows) or not len(weight):
        return None
    kept = slice(first, end)
    episode, place, returns = row_episodes(run)
    return Rows(
        first, whole.rows.numpy()[kept], whole.version[kept], episode[kept], place[kept],
        returns[kept], np.asarray(weight, np.float64),
    )  # fmt: skip


@cached("buffer")
def row_episodes(run: RunReader) -> tuple[NDArray[np.int64], NDArray[np.int64], Floats]:
    """Of each recorded row its episode, its place there and the episode's return, (N,) each."""
    return episodes(recorded(run).rows.numpy())


@cached("snapshot")
def fit_weight(run: RunReader, step: int) -> NDArray[np.float32]:
    """The weights (N,) of a fit."""
    return fresh_reader(run).snapshot(step)["weight"].to_numpy(np.float32)


def observations_around(run: RunReader, rows: Sequence[int]) -> Floats:
    """Observations (R, 2 WINDOW + 1, O) around the recorded rows with these numbers."""
    whole = recorded(run).rows
    return np.asarray(whole.obs, np.float64)[windows(whole.ended(), rows)]


def find_task(run: RunReader) -> Task | None:
    """The run's task; None if its folder does not say what it is."""
    try:
        return task_of(run)
    except UserError:
        return None


def observation_names(run: RunReader) -> tuple[str, ...]:
    """The recorded names of the run's observation dimensions; empty if there are none."""
    task = None if run.env == ROAD else find_task(run)
    return () if task is None else task.obs_names


def obs_and_action_names(run: RunReader) -> tuple[Sequence[str], Sequence[str]]:
    """The names of the dimensions of a run's observations and actions."""
    return dimension_names(run.env, recorded(run).rows, observation_names(run))


def has_robot(run: RunReader) -> bool:
    """Whether there is a robot to draw in the states of the run's buffer."""
    task = None if scene_of(run) is None else find_task(run)
    return task is not None and (
        task.root_dims is not None or bool(recorded_with_states(run).state)
    )


def has_model(run: RunReader) -> bool:
    """Whether the run has a stored model, which may be damaged."""
    return checkpoint.model_step(run.path) is not None


@cached("model")
def stored_model(run: RunReader) -> "StoredModel | str":
    """The run's model, or the reason why there is none."""
    from tom.analysis import imagine

    try:
        return imagine.stored_model(run)
    except UserError as error:
        return str(error)


def model_errors_of(run: RunReader, index: NDArray[np.int64]) -> Floats:
    """The stored model's error on recorded rows, (N,) of the record: NaN for all others."""
    from tom.exams.diagnostics import errors_of_rows

    whole, kept = recorded(run).rows, stored_model(run)
    errors = np.full(len(whole), np.nan)
    if not isinstance(kept, str):  # the page says what is damaged
        errors[index] = errors_of_rows(kept.predictor, whole[index].torch())
    return errors


def stored_policy(run: RunReader, step: int | None = None) -> "StoredPolicy | None":
    """The policy of a run's fit, or that it ended with; None if there is none that can be read."""
    from tom.analysis.weighing import load_policy
    from tom.policy.stored import StoredPolicy

    task, store = find_task(run), Store(run.home.parent)
    try:
        found = None if task is None else load_policy(str(run.path), store, task, step)
    except UserError:
        return None
    return found if isinstance(found, StoredPolicy) else None


@cached("buffer", "model")
def errors_on(run: RunReader, other: RunReader) -> Floats | None:
    """Error (K,) of `other`'s stored model on rows spread evenly over `run`'s buffer.

    None if either cannot be read.
    """
    from tom.exams.diagnostics import errors_of_rows

    whole, kept = recorded(run).rows, stored_model(other)
    if isinstance(kept, str) or not len(whole):
        return None
    part = whole[spread(len(whole), SHARED_ROWS)]
    return errors_of_rows(kept.predictor, part.torch()).numpy().astype(np.float64)
