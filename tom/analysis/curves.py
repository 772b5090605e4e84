"""Curves of single runs, and a statistic over seeds with its band. Pure functions.

A page and a report put runs together here, so that they cannot disagree.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from tom.analysis import statistics
from tom.analysis.settings import Kind, natural_sort_key
from tom.record.reader import RunReader
from tom.spread import spread

Statistic = Literal["mean", "median", "iqm"]
Band = Literal["bootstrap", "deviation", "none"]
RESAMPLES = 1000
GRID = 1000
"""maximum number of steps at which a group is drawn; the figure says if steps were left out"""


@dataclass(frozen=True)
class Curve:
    """One metric of one run; `step` and `value` are (T,), steps ascending, no gaps.

    `step` counts env steps, or is the quantity on the figure's x axis. Runs of one learner and
    preset whose settings differ have different `variant`s, which name the differences.
    """

    run_id: str
    env: str
    learner: str
    preset: str
    seed: int
    step: NDArray
    value: NDArray[np.float64]
    variant: str = ""
    group: Kind | None = None
    """what the runs of its group have in common, if they differ in more than the seed"""
    growing: bool = False
    """whether its training is running"""

    @property
    def final(self) -> float:
        """The last value; NaN if there is none."""
        return float(self.value[-1]) if len(self.value) else np.nan

    @property
    def best(self) -> float:
        """The highest value; NaN if there is none."""
        return float(self.value.max()) if len(self.value) else np.nan

    @property
    def best_so_far(self) -> "Curve":
        """The running maximum of the values, which the paper draws."""
        return replace(self, value=np.maximum.accumulate(self.value))

    def until(self, last: float) -> "Curve":
        """The part of the curve up to step `last`."""
        here = self.step <= last
        return replace(self, step=self.step[here], value=self.value[here])

    @property
    def kind(self) -> Kind:
        """What the runs of its group have in common."""
        return self.group or Kind(self.learner, self.preset, self.variant)


@dataclass(frozen=True)
class Group:
    """The runs of one kind in one environment, on one grid of steps (T,).

    Unless they are grouped by a setting, they differ in nothing but the seed.

    `mean` is the `statistic` over the runs that reach a step, and `count` is their number; `low`
    and `high` are the band, NaN at steps that not all n runs reach and if n is 1. `interpolated`:
    some run has no value of its own at a step of another run, and is interpolated there.
    """

    env: str
    learner: str
    preset: str
    curves: tuple[Curve, ...]
    step: NDArray
    mean: NDArray[np.float64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    count: NDArray[np.int64]
    statistic: Statistic = "mean"
    variant: str = ""
    thinned: bool = False
    interpolated: bool = False

    @property
    def n(self) -> int:
        return len(self.curves)

    @property
    def kind(self) -> Kind:
        """What the group's runs have in common."""
        return Kind(self.learner, self.preset, self.variant)

    @property
    def complete(self) -> NDArray[np.bool_]:
        """Steps (T,) that all n runs reach."""
        return self.count == self.n


def curve_points(frame: pd.DataFrame, metric: str) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """The steps at which `metric` was recorded, and its values."""
    if metric not in frame or frame.empty:
        return np.zeros(0, np.int64), np.zeros(0)
    value = np.asarray(frame[metric], np.float64)
    here = np.isfinite(value)
    return np.asarray(frame["env_step"], np.int64)[here], value[here]


def curve_of(run: RunReader, frame: pd.DataFrame, metric: str) -> Curve:
    """One metric of a run, whose metrics are in `frame`, against env steps."""
    step, value = curve_points(frame, metric)
    named = run.run_id, run.env, run.learner, run.preset, run.seed
    return Curve(*named, step, value, growing=run.status.alive)


def points_against(
    frame: pd.DataFrame, metric: str, other: str
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The values of `other` and of `metric`, in the order of recording.

    If the two were recorded at different steps, `other` is interpolated, never extrapolated.
    """
    step, value = curve_points(frame, metric)
    at, x = curve_points(frame, other)
    if not len(step) or not len(at):
        return np.zeros(0), np.zeros(0)
    beside = np.interp(step, at, x, left=np.nan, right=np.nan)
    here = np.isfinite(beside)
    return beside[here], value[here]


def groups(
    curves: Sequence[Curve], statistic: Statistic = "mean", band: Band = "bootstrap"
) -> list[Group]:
    """The curves grouped by kind, in the order of env, learner, preset, settings."""
    keyed: dict[tuple[str, Kind], list[Curve]] = {}
    for curve in curves:
        if len(curve.step):
            keyed.setdefault((curve.env, curve.kind), []).append(curve)
    return [
        aggregate(sorted(keyed[key], key=lambda c: c.seed), statistic, band)
        for key in sorted(
            keyed, key=lambda key: (key[0], *key[1][:2], natural_sort_key(key[1].variant))
        )
    ]


def aggregate(
    curves: Sequence[Curve], statistic: Statistic = "mean", band: Band = "bootstrap"
) -> Group:
    """A statistic and its band over the runs of one group.

    Runs that were recorded at different steps are interpolated linearly, never extrapolated.
    """
    grid = np.unique(np.concatenate([c.step for c in curves]))
    # The grid has every run's steps, so a run with fewer steps in its range lacks some.
    between = any(((grid >= c.step[0]) & (grid <= c.step[-1])).sum() > len(c.step) for c in curves)
    thinned = len(grid) > GRID
    if thinned:
        some = grid[spread(len(grid), GRID - 1)]
        grid = np.union1d(some, [min(c.step[-1] for c in curves)])  # where a table compares runs
    outside = {"left": np.nan, "right": np.nan}  # the steps that a curve covers
    values = np.stack([np.interp(grid, c.step, c.value, **outside) for c in curves])  # (n, T)
    count = np.isfinite(values).sum(0)
    complete = count == len(curves)
    middle = np.empty(len(grid))
    for n in np.unique(count):
        # All columns with n runs at once; no statistic depends on the order of runs.
        columns = np.sort(values[:, count == n], axis=0)[:n]  # NaN comes last
        middle[count == n] = statistics.STATISTICS[statistic](columns.T) if n else np.nan
    low, high = np.full(len(grid), np.nan), np.full(len(grid), np.nan)
    if len(curves) > 1 and complete.any():
        known = values[:, complete]  # (n, T)
        if band == "bootstrap":
            bounds = statistics.band(known, statistics.STATISTICS[statistic], RESAMPLES)
            low[complete], high[complete] = bounds
        elif band == "deviation":
            mean, deviation = known.mean(0), known.std(0, ddof=1)
            low[complete], high[complete] = mean - deviation, mean + deviation
    learner, preset, variant = curves[0].kind
    return Group(
        curves[0].env, learner, preset, tuple(curves), grid, middle, low, high, count,
        statistic, variant, thinned, between,
    )  # fmt: skip


def smoothed(group: Group, window: int) -> Group:
    """Centred moving average over `window` points of the group's line and band.

    The average is over the statistic, not over single runs. Steps that all runs reach and other
    steps are averaged separately, because they are statistics of different runs; the window is
    shorter at both ends of each stretch.
    """
    if window < 2:
        return group
    ends = np.flatnonzero(np.diff(group.complete)) + 1

    def moving(value: NDArray[np.float64]) -> NDArray[np.float64]:
        means = [
            pd.Series(part).rolling(window, center=True, min_periods=1).mean()
            for part in np.split(value, ends)
        ]
        return np.where(np.isfinite(value), np.concatenate(means), np.nan)

    return replace(group, mean=moving(group.mean), low=moving(group.low), high=moving(group.high))
