"""A replay buffer at one model fit, with properties of each transition. Pure functions."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tom.data.transitions import Transitions
from tom.envs import ENVS, ROAD

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


def episodes(rows: Transitions) -> tuple[NDArray[np.int64], NDArray[np.int64], Floats]:
    """For each row (N,): the number of its episode, its place in it, and the episode's return."""
    ended = rows.ended()
    number = np.concatenate([[0], np.cumsum(ended)[:-1]]).astype(np.int64)[: len(rows)]
    starts = np.searchsorted(number, np.arange(number[-1] + 1)) if len(number) else number
    totals = np.bincount(number, np.asarray(rows.reward, np.float64)).astype(np.float64)
    return number, np.arange(len(rows)) - starts[number], totals[number]


def dimension_names(
    env: str, rows: Transitions, described: Sequence[str] = ()
) -> tuple[list[str], list[str]]:
    """The names of the observation's and the action's dimensions, (O,) and (A,).

    `described` are the names that a run has recorded for a task that is not ours.
    """
    o, a = np.shape(rows.obs)[1], np.shape(rows.action)[1]
    named = ("x", "y") if env == ROAD else ENVS[env].obs_names if env in ENVS else described
    names = list(named) if len(named) == o else [f"observation {i + 1}" for i in range(o)]
    return names, [f"action {i + 1}" for i in range(a)]


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
