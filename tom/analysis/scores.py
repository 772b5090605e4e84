"""Scores of runs up to a step that all runs reach, and comparisons of them. Pure functions."""

from collections.abc import Iterable, Sequence

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from tom.analysis import statistics
from tom.analysis.curves import Curve, Statistic
from tom.analysis.statistics import Interval

Floats = NDArray[np.float64]

FINAL, BEST, HEIGHT = "value at the end", "best value", "mean height"
"""of the curve as it is drawn: between two points it is the straight line that joins them"""
SCORES = (FINAL, BEST, HEIGHT)
ESS = "weights/ess"


def common_step(curves: Iterable[Curve]) -> float:
    """The last step that all curves reach; every curve has at least one point."""
    return min(float(curve.step[-1]) for curve in curves)


def common_start(curves: Iterable[Curve]) -> float:
    """The first step from which on all curves have points; every curve has at least one."""
    return max(float(curve.step[0]) for curve in curves)


def all_have_started(curves: Iterable[Curve], until: float) -> bool:
    """Whether every curve has a point up to step `until`, so that all runs have a score."""
    return all(curve.step[0] <= until for curve in curves)


def scores_of(curves: Sequence[Curve], score: str, until: float, since: float = -np.inf) -> Floats:
    """The score of each run (n,) up to step `until`; NaN for a run without a point up to there.

    A mean height is that from step `since` on: returns grow, so that who was first evaluated later
    would stand higher. It is NaN for a curve that ends before `until`.
    """
    return np.array([_score(curve, score, until, since) for curve in curves], np.float64)


def _score(curve: Curve, score: str, until: float, since: float) -> float:
    cut = curve.until(until)
    if not len(cut.step):
        return np.nan
    end = float(np.interp(until, curve.step, curve.value))
    if score == FINAL:
        return end
    if score == BEST:
        return max(cut.best, end)
    if curve.step[-1] < until:
        return np.nan  # curves are never extrapolated
    first = max(since, float(curve.step[0]))
    if until <= first:
        return end  # an area without width: its value is the mean height
    between = curve.step[(curve.step > first) & (curve.step < until)]
    x = np.concatenate([[first], between, [until]]).astype(np.float64)
    return float(np.trapezoid(np.interp(x, curve.step, curve.value), x) / (until - first))


def steps_to(curves: Sequence[Curve], level: float, until: float) -> Floats:
    """The first recorded step (n,) at which each run reaches `level`; infinity if it does not.

    Steps after `until` do not count, because runs that ended earlier have none. In a median over
    seeds, infinity counts as later than every run that reached the level.
    """
    reached = [curve.step[(curve.value >= level) & (curve.step <= until)] for curve in curves]
    return np.array([steps[0] if len(steps) else np.inf for steps in reached], np.float64)


def interval(values: Floats, statistic: Statistic = "mean") -> Interval:
    """A statistic of n numbers and its bootstrap interval.

    The bounds are NaN if n is 1; everything is NaN if a value is missing.
    """
    if not len(values) or not np.isfinite(values).all():
        return Interval(np.nan, np.nan, np.nan)
    return statistics.interval([values], statistics.STATISTICS[statistic])


def contrast(groups: Sequence[Floats], signs: Sequence[float]) -> Interval:
    """A weighted sum of the means of groups of scores (n,), and its bootstrap interval."""

    def total(*groups: Floats, axis: int = -1) -> Floats:
        means = [sign * group.mean(axis) for sign, group in zip(signs, groups, strict=True)]
        return np.sum(means, axis=0)

    return statistics.interval(groups, total)


def counted_from(runs: Iterable[pd.DataFrame]) -> float:
    """The step of the fit from which on every run weighs, from the runs' metrics.

    Until a learner knows its policy, its weights are uniform (TOM's warm-up), and its exams say
    nothing of it. Runs that never weigh do not count; -infinity if none does.
    """
    first = [metrics.loc[metrics[ESS] < 1, "env_step"].min() for metrics in runs if ESS in metrics]
    return max((float(step) for step in first if np.isfinite(step)), default=-np.inf)
