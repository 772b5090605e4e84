"""Planes on which a replay buffer is drawn, and the share of its log weights that one explains.

A row's features are its (s, a, s'), standardised. The contrast plane is spanned by the directions
along which the log weights differ most: partial least squares with one response (Wold 1966) and two
components. The weights of zero of many learners would decide everything, so they are clipped.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from tom.data.transitions import Transitions, episodes
from tom.spread import spread

FITTED = 50_000
"""maximum number of rows from which a plane is computed"""
CHUNK = 65_536
"""rows whose features are held at a time"""
CLIP = 1 / 32
"""lighter rows, as a multiple of the mean weight, count as this light"""
ROWS_PER_CELL = 24
MAX_LOADINGS = 2
"""number of dimensions after which an axis is named"""
CONSTANT = 1e-9
"""a feature with a smaller standard deviation does not vary"""


Names = tuple[Sequence[str], Sequence[str]]
"""of the O dimensions of observations and the A of actions"""


@dataclass(frozen=True)
class Plane:
    """Two directions of D standardised features, through their means."""

    axes: NDArray[np.float64]  # (D, 2)
    mean: NDArray[np.float64]  # (D,) of the features
    scale: NDArray[np.float64]  # (D,) over their standard deviations; 0 for constants
    names: tuple[str, str]

    def project(self, table: NDArray) -> NDArray[np.float32]:
        """Features (N, D), not standardised, as coordinates (N, 2)."""
        scaled = (table - self.mean.astype(np.float32)) * self.scale.astype(np.float32)
        return (scaled @ self.axes.astype(np.float32)).astype(np.float32)


def features(rows: Transitions) -> NDArray[np.float32]:
    """(s, a, s') of N rows, (N, D)."""
    whole = rows.numpy()
    return np.concatenate([whole.obs, whole.action, whole.next_obs], 1).astype(np.float32)


def feature_names(obs: Sequence[str], action: Sequence[str]) -> list[str]:
    """The names of the D = 2 O + A features."""
    return [*obs, *action, *(f"next {name}" for name in obs)]


def standard(table: NDArray) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The mean of features (N, D), and one over their deviations, 0 for constants: (D,) each."""
    if not len(table):
        return np.zeros(table.shape[1]), np.zeros(table.shape[1])
    mean, deviation = table.mean(0, dtype=np.float64), table.std(0, dtype=np.float64)
    return mean, np.where(deviation > CONSTANT, 1 / np.maximum(deviation, CONSTANT), 0.0)


def coordinates(
    plane: Plane, count: int, table_of: Callable[[slice], NDArray]
) -> NDArray[np.float32]:
    """The coordinates (N, 2) of `count` rows, whose features are made a part at a time."""
    parts = (slice(first, first + CHUNK) for first in range(0, count, CHUNK))
    projected = [plane.project(table_of(part)) for part in parts]
    return np.concatenate([np.zeros((0, 2), np.float32), *projected])


def of_rows(plane: Plane, rows: Transitions) -> NDArray[np.float32]:
    """The coordinates (N, 2) of rows on a plane of their features."""
    return coordinates(plane, len(rows), lambda part: features(rows[part]))


def log_weights(weight: NDArray) -> NDArray[np.float64]:
    """log2 of weights (N,) relative to their mean, at least log2(CLIP)."""
    weight = np.asarray(weight, np.float64)
    mean = weight.mean() if len(weight) else 0.0
    relative = weight / mean if mean > 0 else np.ones_like(weight)
    return np.log2(np.maximum(relative, CLIP))


def contrast_of(rows: Transitions, weight: NDArray, names: Names) -> Plane:
    """The plane of N rows where their weights (N,) differ most; they grow along the first axis.

    Computed from at most FITTED rows. If no direction goes with the weights, the principal
    components.
    """
    part = spread(len(rows), FITTED)
    table = features(rows[part])
    mean, scale = standard(table)
    x, y = (table - mean) * scale, log_weights(np.asarray(weight)[part])
    along = x.T @ (y - y.mean()) if len(y) else np.zeros(len(mean))
    axes: list[NDArray[np.float64]] = []
    for _ in range(2):
        size = np.linalg.norm(along)
        if size < CONSTANT:
            return principal_of(rows, names)
        axes.append(along / size)
        score = x @ axes[-1]
        # What the first component leaves of X' y; its score has mean 0, so y need not be centred.
        along = along - x.T @ score * (score @ y / (score @ score))
    return Plane(np.stack(axes, 1), mean, scale, axis_names(np.stack(axes, 1), names))


def principal_of(rows: Transitions, names: Names) -> Plane:
    """The first two principal components of N rows, from at most FITTED of them."""
    table = features(rows[spread(len(rows), FITTED)])
    mean, scale = standard(table)
    axes = _components((table - mean) * scale) * (scale > 0)[:, None]
    return Plane(axes, mean, scale, axis_names(axes, names))


def of_layer(hidden: NDArray) -> Plane:
    """The first two principal components of a layer's activations (N, H), not standardised."""
    mean = hidden.mean(0, dtype=np.float64)
    axes = _components(hidden - mean)
    return Plane(axes, mean, np.ones(len(mean)), ("component 1", "component 2"))


def _components(centred: NDArray) -> NDArray[np.float64]:
    """The first two principal axes (D, 2) of a table (N, D) of mean 0."""
    axes = np.linalg.eigh(centred.T.astype(np.float64) @ centred)[1][:, ::-1][:, :2]
    if axes.shape[1] < 2:
        axes = np.concatenate([axes, np.zeros((len(axes), 1))], 1)
    return axes * np.sign(axes[np.abs(axes).argmax(0), np.arange(2)])


def axis_names(axes: NDArray, names: Names) -> tuple[str, str]:
    """Two axes (D, 2) by their largest loadings: `leg angle down, torso x velocity up`."""

    def of(axis: NDArray) -> str:
        signs = loadings(axis, feature_names(*names)).items()
        words = ", ".join(f"{name} {'up' if sign > 0 else 'down'}" for name, sign in signs)
        return words or "no dimension varies"

    return of(axes[:, 0]), of(axes[:, 1])


def loadings(axis: NDArray, names: Sequence[str]) -> dict[str, int]:
    """The signs of an axis's largest loadings (D,) by name, the largest first.

    A dimension of s and the same of s' are one.
    """
    largest: dict[str, int] = {}
    for i in np.argsort(-np.abs(axis), kind="stable"):
        if axis[i] != 0:
            largest.setdefault(names[int(i)].removeprefix("next "), 1 if axis[i] > 0 else -1)
    return dict(list(largest.items())[:MAX_LOADINGS])


def explained_share(xy: NDArray, weight: NDArray) -> float:
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


# The rows of a buffer as one table: where each is in its episode, its weight, its coordinates.

FIELDS = ("obs", "action", "reward", "next_obs", "terminated", "truncated")


def transition_table(rows: Transitions) -> pd.DataFrame:
    """One row per transition; a vector has one column per dimension: `obs_0`, `obs_1`, ..."""
    part = rows.numpy()
    columns: dict[str, NDArray] = {}
    for name in FIELDS:
        values = np.asarray(getattr(part, name))
        if values.ndim == 1:
            columns[name] = values != 0 if name in ("terminated", "truncated") else values
        else:
            columns |= {f"{name}_{i}": values[:, i] for i in range(values.shape[1])}
    return pd.DataFrame(columns)


def row_table(
    record: Transitions,
    weight: NDArray,
    end: int,
    names: Names,
    more: Mapping[str, NDArray] | None = None,
) -> pd.DataFrame:
    """The N rows before row `end` of a record, with weights (N,), and `more` columns (N,).

    `row` and `episode` count the whole record, `age` is in % of the N rows, 0 the oldest. The
    coordinates are those on planes of these rows and weights; `names` are those of the O and A
    dimensions of observations and actions.
    """
    count, first = len(weight), end - len(weight)
    whole = record.numpy()
    rows = whole[first:end]
    episode, place, _ = episodes(whole)
    placed = {
        "contrast": of_rows(contrast_of(rows, weight, names), rows),
        "pc": of_rows(principal_of(rows, names), rows),
    }
    return pd.concat(
        [
            pd.DataFrame(
                {
                    "row": np.arange(first, end),
                    "episode": episode[first:end],
                    "episode_step": place[first:end],
                    "age": (np.arange(count) + 0.5) * 100 / max(count, 1),
                }
            ),
            transition_table(rows),
            pd.DataFrame(
                {"weight": np.asarray(weight, np.float32)}
                | {f"{kind}_{i}": xy[:, i] for kind, xy in placed.items() for i in (0, 1)}
                | dict(more or {})
            ),
        ],
        axis=1,
    )
