"""Regions of a replay buffer: a map, and the content of a part of it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from app.data.buffer import Floats, Rows
from app.data.cache import VersionedCache
from tom.data.sampling import ess, zero_share
from tom.data.transitions import Transitions
from tom.record.reader import RunReader
from tom.spread import spread

Mask = NDArray[np.bool_]

FITTED = 20_000
"""maximum number of rows from which principal components are computed"""


@dataclass(frozen=True)
class Plane:
    """Two coordinates of every transition, with their names."""

    x: Floats  # (N,)
    y: Floats  # (N,)
    x_name: str
    y_name: str


def principal_plane(rows: Transitions) -> Plane:
    """The first two principal components of (s, a, s'), with standardised dimensions.

    Computed from at most FITTED evenly drawn rows; the coordinates are those of all N.
    """
    part = rows[spread(len(rows), FITTED)].numpy()
    table = np.concatenate([part.obs, part.action, part.next_obs], 1).astype(np.float64)
    middle, deviation = table.mean(0), table.std(0)
    # Constants are left out.
    scale = np.where(deviation > 1e-9, 1 / np.maximum(deviation, 1e-9), 0.0)
    table = (table - middle) * scale
    values, vectors = np.linalg.eigh(table.T @ table / max(len(table), 1))
    vectors = vectors[:, ::-1][:, :2]
    # An eigenvector's sign is arbitrary: the largest entry is made positive.
    vectors = vectors * np.sign(vectors[np.abs(vectors).argmax(0), np.arange(vectors.shape[1])])
    share = 100 * values[::-1][:2] / values.sum()
    turned = (scale[:, None] * vectors).astype(np.float32)
    whole, o = rows.numpy(), np.shape(rows.obs)[1]
    coordinates = np.asarray(whole.obs) @ turned[:o] + np.asarray(whole.next_obs) @ turned[-o:]
    coordinates = coordinates + np.asarray(whole.action) @ turned[o:-o] - (middle * scale) @ vectors
    coordinates = coordinates.astype(np.float64)
    names = [f"component {i + 1} ({share[i]:.0f} % of the variance)" for i in range(2)]
    return Plane(coordinates[:, 0], coordinates[:, 1], names[0], names[1])


_PLANES: VersionedCache[Plane] = VersionedCache()


def plane_of(run: RunReader, rows: Rows) -> Plane:
    """The `principal_plane` of some of a run's rows, cached."""
    version = run.version("buffer"), rows.first, len(rows)
    return _PLANES.get(run.path, lambda: principal_plane(rows.rows), version)


def named_plane(rows: Transitions, names: Sequence[str], x: str, y: str) -> Plane:
    """Two dimensions of the observation, chosen by name."""
    obs = np.asarray(rows.obs, np.float64)
    return Plane(obs[:, names.index(x)], obs[:, names.index(y)], x, y)


def inside(outline: Sequence[tuple[float, float]], x: Floats, y: Floats) -> Mask:
    """A mask (N,) of the points inside a closed outline of corners (x, y), by the even-odd rule."""
    mask = np.zeros(len(x), bool)
    corners = np.asarray(outline, np.float64).reshape(-1, 2)
    for (x0, y0), (x1, y1) in zip(corners, np.roll(corners, -1, 0), strict=True):
        crosses = (y0 > y) != (y1 > y)
        if y1 != y0:
            mask ^= crosses & (x < x0 + (y - y0) / (y1 - y0) * (x1 - x0))
    return mask


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


EXPLORED = "from exploration, %"


def summary(rows: Rows, mask: Mask) -> dict[str, float]:
    """What a region holds, by quantity; all but the number are NaN if it is empty."""
    n, whole, weight = int(mask.sum()), rows.rows.numpy(), rows.weight[mask]

    def mean(values: NDArray) -> float:
        return float(values[mask].mean()) if n else np.nan

    total = rows.weight.sum()
    return {
        "transitions": float(n),
        "share of the buffer, %": 100 * n / len(rows) if n else np.nan,
        "share of the weight, %": float(100 * weight.sum() / total) if n and total > 0 else np.nan,
        "mean weight": mean(rows.weight),
        "weight zero, %": 100 * zero_share(weight) if n else np.nan,
        "effective sample, %": 100 * ess(weight) if n else np.nan,
        "mean reward": mean(np.asarray(whole.reward)),
        "mean return of their episodes": mean(rows.episode_return),
        "mean age, % (0: oldest)": mean(rows.age),
        EXPLORED: 100 * mean(rows.version == 0) if rows.policies_known else np.nan,
        "ends an episode, %": 100 * mean(whole.ended()),
    }


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
