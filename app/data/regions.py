"""Parts of a replay buffer: the heaviest rows, and what sets rows apart."""

import numpy as np
from numpy.typing import NDArray

from app.data.buffer import Floats, Rows
from app.data.selection import Mask


def heaviest(weight: Floats, share: float) -> Mask:
    """A mask of the rows with the largest weights, a `share` of all rows (at least one)."""
    count = max(round(share * len(weight)), 1)
    mask = np.zeros(len(weight), bool)
    mask[_by_weight(weight)[::-1][:count]] = True
    return mask


def _by_weight(weight: Floats) -> NDArray[np.int64]:
    """The row numbers by ascending weight.

    Among equal weights, of which there may be many, no part of the buffer is preferred.
    """
    shuffled = np.random.default_rng(0).permutation(len(weight))
    return shuffled[np.argsort(weight[shuffled], kind="stable")]


def apart(rows: Rows, mask: Mask, names: list[str]) -> list[tuple[str, float]]:
    """The distance of a region's mean of each of (s, a) from the buffer's, in its deviations.

    `names` are those of the dimensions of s, then of a. The farthest comes first; constants are
    left out.
    """
    if not mask.any():
        return []
    table = np.concatenate([rows.rows.obs, rows.rows.action], 1)
    here, whole = (part.mean(0, dtype=np.float64) for part in (table[mask], table))
    deviation = table.std(0, dtype=np.float64)
    gap = (here - whole) / np.where(deviation > 1e-9, deviation, np.inf)
    order = np.argsort(-np.abs(gap), kind="stable")
    return [(names[i], float(gap[i])) for i in order if deviation[i] > 1e-9]


def heavy_and_light(rows: Rows, mask: Mask, count: int, gap: int) -> tuple[list[int], list[int]]:
    """The heaviest and the lightest rows of a region, at least `gap` steps apart."""

    def first_of(order: NDArray[np.int64]) -> list[int]:
        picked: list[int] = []
        for row in order.tolist():
            if len(picked) == count:
                break
            if all(abs(row - other) >= gap for other in picked):
                picked.append(row)
        return picked

    index = np.flatnonzero(mask)
    by_weight = index[_by_weight(rows.weight[index])]
    return first_of(by_weight[::-1]), first_of(by_weight)
