"""Recorded columns as transitions: the rules that all foreign formats share."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from tom.data.transitions import Transitions
from tom.errors import UserError

Where = str | Path


def assemble(
    obs: NDArray,
    action: NDArray,
    reward: NDArray,
    terminated: NDArray,
    next_obs: NDArray | None,
    truncated: NDArray | None,
) -> Transitions:
    """Columns of N > 0 rows as transitions; `next_obs` or `truncated` may be missing, not both.

    An episode whose recording stops without a terminal state is truncated, so a row after a
    terminated or truncated one starts an episode. Without `next_obs` the observation of the next
    row is used, but never across episodes: the last row of each episode is dropped, and the row
    before it is marked as truncated.
    """
    terminated = terminated != 0
    if next_obs is None:
        assert truncated is not None
        ends = terminated | (truncated != 0)
        ends[-1] = True
        return _shifted(obs, action, reward, ends)
    if truncated is None:
        cut = np.append((next_obs[:-1] != obs[1:]).any(axis=1), True)
    else:
        cut = truncated != 0
    cut[-1] = True
    return Transitions(obs, action, reward, next_obs, terminated, cut & ~terminated)


def check_finite(where: Where, columns: Mapping[str, NDArray | None]) -> None:
    """Raises UserError if a column (N, ...) contains a number that is not finite."""
    for name, values in columns.items():
        if values is None or np.isfinite(values).all():
            continue
        rows = np.flatnonzero(~np.isfinite(values).reshape(len(values), -1).all(1))
        raise UserError(
            f"{where}: '{name}' is not finite in {len(rows)} rows, first in row {rows[0]}: leave "
            "out the episodes that hold them"
        )


def _shifted(obs: NDArray, action: NDArray, reward: NDArray, ends: NDArray) -> Transitions:
    """All rows except the last of each episode, with the next row's observation."""
    kept = np.flatnonzero(~ends)
    terminated = np.zeros(len(kept), bool)
    return Transitions(
        obs[kept], action[kept], reward[kept], obs[kept + 1], terminated, ends[kept + 1]
    )
