"""Planes on which a replay buffer is drawn, and the share of its log weights that one explains.

A row's features are its (s, a, s'), standardised. The contrast plane is spanned by the directions
along which the log weights differ most: partial least squares with one response (Wold 1966) and two
components. The weights of zero of many learners would decide everything, so they are clipped.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tom.data.transitions import Transitions
from tom.spread import spread

FITTED = 50_000
"""maximum number of rows from which a plane is computed"""
CLIP = 1 / 32
"""lighter rows, as a multiple of the mean weight, count as this light"""
ROWS_PER_CELL = 24
NAMED = 2
"""number of dimensions after which an axis is named"""
CONSTANT = 1e-9
"""a feature with a smaller standard deviation does not vary"""


@dataclass(frozen=True)
class Plane:
    """Two directions of D features, through a centre."""

    kind: str
    axes: NDArray[np.float64]  # (D, 2)
    centre: NDArray[np.float64]  # (D,)
    names: tuple[str, str]

    def project(self, features: NDArray) -> NDArray[np.float32]:
        """Features (N, D) as coordinates (N, 2)."""
        shift = self.centre @ self.axes
        return (features @ self.axes.astype(np.float32) - shift).astype(np.float32)


def features(
    rows: Transitions, obs: Sequence[str], action: Sequence[str]
) -> tuple[NDArray[np.float32], list[str]]:
    """(s, a, s') of N rows, standardised, (N, D), and the names of the D = 2 O + A features."""
    whole = rows.numpy()
    table = np.concatenate([whole.obs, whole.action, whole.next_obs], 1).astype(np.float32)
    part = table[spread(len(table), FITTED)].astype(np.float64)
    mean, deviation = (part.mean(0), part.std(0)) if len(part) else np.zeros((2, table.shape[1]))
    scale = np.where(deviation > CONSTANT, 1 / np.maximum(deviation, CONSTANT), 0.0)
    table -= mean.astype(np.float32)
    table *= scale.astype(np.float32)
    return table, [*obs, *action, *(f"next {name}" for name in obs)]


def log_weights(weight: NDArray) -> NDArray[np.float64]:
    """log2 of weights (N,) relative to their mean, at least log2(CLIP)."""
    weight = np.asarray(weight, np.float64)
    mean = weight.mean() if len(weight) else 0.0
    relative = weight / mean if mean > 0 else np.ones_like(weight)
    return np.log2(np.maximum(relative, CLIP))


def contrast(table: NDArray, weight: NDArray, names: Sequence[str]) -> Plane:
    """The plane of features (N, D) where weights (N,) differ most; they grow along the first axis.

    If no direction goes with the weights, the principal components.
    """
    part = spread(len(table), FITTED)
    x, y = table[part].astype(np.float64), log_weights(weight)[part]
    centre = x.mean(0) if len(x) else np.zeros(table.shape[1])
    left, y = x - centre, y - y.mean() if len(y) else y
    axes: list[NDArray[np.float64]] = []
    for _ in range(2):
        axis = left.T @ y
        size = np.linalg.norm(axis)
        if size < CONSTANT:
            return principal(table, names, "contrast")
        axes.append(axis / size)
        score = left @ axes[-1]
        left = left - np.outer(score, left.T @ score / (score @ score))
    spanning = np.stack(axes, 1)  # orthogonal: components of partial least squares are
    return Plane(
        "contrast", spanning, centre, (described(axes[0], names), described(axes[1], names))
    )


def principal(table: NDArray, names: Sequence[str], kind: str = "principal") -> Plane:
    """The first two principal components of features (N, D)."""
    part = table[spread(len(table), FITTED)].astype(np.float64)
    centre = part.mean(0) if len(part) else np.zeros(table.shape[1])
    _, vectors = np.linalg.eigh((part - centre).T @ (part - centre))
    axes = vectors[:, ::-1][:, :2]
    if axes.shape[1] < 2:
        axes = np.concatenate([axes, np.zeros((len(axes), 1))], 1)
    axes = axes * np.sign(axes[np.abs(axes).argmax(0), np.arange(2)])
    return Plane(kind, axes, centre, (described(axes[:, 0], names), described(axes[:, 1], names)))


def of_layer(hidden: NDArray, kind: str) -> Plane:
    """The first two principal components of a layer's activations (N, H)."""
    plane = principal(hidden, [""] * hidden.shape[1], kind)
    return Plane(kind, plane.axes, plane.centre, ("component 1", "component 2"))


def described(axis: NDArray, names: Sequence[str]) -> str:
    """An axis (D,) by its largest loadings: `leg angle down, torso x velocity up`."""
    signs = loadings(axis, names).items()
    return ", ".join(f"{name} {'up' if sign > 0 else 'down'}" for name, sign in signs)


def loadings(axis: NDArray, names: Sequence[str]) -> dict[str, int]:
    """The signs of an axis's largest loadings (D,) by name, the largest first.

    A dimension of s and the same of s' are one.
    """
    largest: dict[str, int] = {}
    for i in np.argsort(-np.abs(axis), kind="stable"):
        if axis[i] != 0:
            largest.setdefault(names[int(i)].removeprefix("next "), 1 if axis[i] > 0 else -1)
    return dict(list(largest.items())[:NAMED])


def explained(xy: NDArray, weight: NDArray) -> float:
    """The share of the log weights (N,) that the cells of a plane (N, 2) explain; 0 at the least.

    The cells' means, drawn towards the mean of all by one row, are those of a random half of the
    rows; the share is that of the other half. The cells lie between the .5 % quantiles of the axes,
    with `ROWS_PER_CELL` rows each on average.
    """
    y, n = log_weights(weight), len(weight)
    if n < 4 or np.ptp(y) == 0:
        return 0.0
    side = max(int(np.sqrt(n / ROWS_PER_CELL)), 1)
    cell = np.zeros(n, np.int64)
    for axis in np.asarray(xy, np.float64).T:
        low, high = np.quantile(axis, [0.005, 0.995])
        place = (axis - low) / (high - low or 1) * side
        cell = cell * side + np.clip(place.astype(np.int64), 0, side - 1)
    fitted = np.random.default_rng(0).random(n) < 0.5
    mean = y[fitted].mean()
    total = np.bincount(cell[fitted], y[fitted], side * side)
    of_cell = (total + mean) / (np.bincount(cell[fitted], minlength=side * side) + 1)
    held_out = y[~fitted]
    error = np.square(held_out - of_cell[cell[~fitted]]).mean()
    spread_out = np.square(held_out - mean).mean()
    return max(float(1 - error / spread_out), 0.0) if spread_out > 0 else 0.0
