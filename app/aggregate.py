"""Curves of single runs, and their mean over seeds with a bootstrap band. Pure functions."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import pandas as pd
from numpy.typing import NDArray

RESAMPLES = 1000
LEVEL = 0.95


@dataclass(frozen=True)
class Curve:
    """One metric of one run against env steps; both (T,), steps ascending, no gaps."""

    run_id: str
    env: str
    learner: str
    preset: str
    seed: int
    step: NDArray[np.int64]
    value: NDArray[np.float64]

    @property
    def final(self) -> float:
        return float(self.value[-1])

    @property
    def best(self) -> float:
        return float(self.value.max())


@dataclass(frozen=True)
class Group:
    """The runs that differ in nothing but the seed, on one grid of steps (T,).

    `mean` is over the runs that reach a step, `count` says how many those are; `low` and `high`
    are the band, NaN wherever not all n runs are there or n is 1.
    """

    env: str
    learner: str
    preset: str
    curves: tuple[Curve, ...]
    step: NDArray[np.int64]
    mean: NDArray[np.float64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    count: NDArray[np.int64]

    @property
    def n(self) -> int:
        return len(self.curves)

    @property
    def complete(self) -> NDArray[np.bool_]:
        """Steps (T,) that all n runs reach."""
        return self.count == self.n

    @property
    def interpolated(self) -> bool:
        """Not every run was recorded at every step of the grid that it covers."""
        last = [
            self.step[(self.step >= c.step[0]) & (self.step <= c.step[-1])] for c in self.curves
        ]
        return any(len(grid) > len(c.step) for grid, c in zip(last, self.curves, strict=True))


def curve_points(frame: pd.DataFrame, metric: str) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """The steps and values of `metric` where it was recorded."""
    if metric not in frame or frame.empty:
        return np.zeros(0, np.int64), np.zeros(0)
    value = np.asarray(frame[metric], np.float64)
    here = np.isfinite(value)
    return np.asarray(frame["env_step"], np.int64)[here], value[here]


def groups(curves: Sequence[Curve]) -> list[Group]:
    """The curves grouped by everything except the seed, in order of env, learner, preset."""
    keyed: dict[tuple[str, str, str], list[Curve]] = {}
    for curve in curves:
        if len(curve.step):
            keyed.setdefault((curve.env, curve.learner, curve.preset), []).append(curve)
    return [aggregate(sorted(keyed[key], key=lambda c: c.seed)) for key in sorted(keyed)]


def aggregate(curves: Sequence[Curve]) -> Group:
    """The mean and its bootstrap band over runs of one group.

    Runs that were recorded at other steps are interpolated linearly, never extrapolated.
    """
    grid = np.unique(np.concatenate([c.step for c in curves]))
    values = np.stack([on_grid(c, grid) for c in curves])  # (n, T)
    here = np.isfinite(values)
    count = here.sum(0)
    mean = np.where(here, values, 0.0).sum(0) / np.maximum(count, 1)
    low, high = np.full(len(grid), np.nan), np.full(len(grid), np.nan)
    complete = count == len(curves)
    if len(curves) > 1 and complete.any():
        low[complete], high[complete] = bootstrap_band(values[:, complete])
    first = curves[0]
    return Group(
        first.env, first.learner, first.preset, tuple(curves), grid, mean, low, high, count
    )


def on_grid(curve: Curve, grid: NDArray[np.int64]) -> NDArray[np.float64]:
    """The curve's values (T,) on `grid`, NaN outside the steps that it covers."""
    return np.interp(grid, curve.step, curve.value, left=np.nan, right=np.nan)


def bootstrap_band(
    values: NDArray[np.float64], level: float = LEVEL, resamples: int = RESAMPLES
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Percentile bootstrap band of the mean over n runs: (n, T) -> low (T,), high (T,).

    The draws are the same at every call, so a page does not flicker.
    """
    n = len(values)
    draws = np.random.default_rng(0).multinomial(n, np.full(n, 1 / n), size=resamples)
    means = draws @ values / n  # (resamples, T)
    low, high = np.quantile(means, [(1 - level) / 2, (1 + level) / 2], axis=0)
    return low, high


def interval(values: NDArray[np.float64]) -> tuple[float, float, float]:
    """Mean of n numbers and its bootstrap interval; NaN bounds where n is 1."""
    if len(values) < 2:
        return float(values.mean()), np.nan, np.nan
    low, high = bootstrap_band(values[:, None])
    return float(values.mean()), float(low[0]), float(high[0])


def decimate(
    step: NDArray[np.int64], value: NDArray[np.float64], limit: int
) -> tuple[NDArray[np.int64], NDArray[np.float64], bool]:
    """At most `limit` points that keep every bucket's lowest and highest, and whether any left."""
    if len(step) <= limit:
        return step, value, False
    edges = np.linspace(0, len(step), limit // 2 + 1).astype(int)
    keep = [
        index
        for a, b in pairwise(edges)
        for index in sorted({a + int(np.argmin(value[a:b])), a + int(np.argmax(value[a:b]))})
    ]
    return step[keep], value[keep], True
