"""One number a run, and what the numbers of groups of runs say. Pure functions."""

import math
from collections.abc import Sequence
from itertools import combinations

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from app.data.aggregate import Group
from tom.analysis import statistics

FINAL, BEST, HEIGHT = "value at the end", "best value", "mean height"
SCORES = (FINAL, BEST, HEIGHT)
REACH = 0.8
"""share of the way from the worst to the best score: the default of `steps to reach`"""


def scores_of(group: Group, score: str, until: float) -> NDArray[np.float64]:
    """One number a run (n,), of what was recorded up to step `until`."""
    found = []
    for curve in group.curves:
        cut = curve.until(until)
        height = statistics.area_under_curve(curve.step, curve.value, until)
        # A curve that begins where it ends has no area: its one value is its height.
        height = height if np.isfinite(height) else cut.final
        found.append({FINAL: cut.final, BEST: cut.best, HEIGHT: height}[score])
    return np.array(found, np.float64)


def default_level(scores: NDArray[np.float64]) -> float:
    """A value that good runs reach and others may not, rounded down to a hundredth of their spread.

    Where all scores are the same it is that score.
    """
    low, high = float(scores.min()), float(scores.max())
    if high <= low:
        return low
    unit = 10.0 ** (2 - math.floor(math.log10(high - low)))
    return math.floor((low + REACH * (high - low)) * unit) / unit


def compared(
    names: Sequence[str], scores: Sequence[NDArray[np.float64]]
) -> list[tuple[str, str, statistics.Interval]]:
    """P(first beats second) for every pair of groups."""
    draws = np.random.default_rng(0)
    return [
        (
            names[i],
            names[j],
            statistics.probability_of_improvement(scores[i][:, None], scores[j][:, None], draws),
        )
        for i, j in combinations(range(len(names)), 2)
    ]


def reached(
    grouped: Sequence[Group], names: Sequence[str], level: float, until: float
) -> pd.DataFrame:
    """For each group how many runs reach the level by step `until`, and the median step at which.

    A run that does so later counts as one that does not, as runs that ended before must.
    """
    rows = []
    for name, group in zip(names, grouped, strict=True):
        cut = [curve.until(until) for curve in group.curves]
        steps = np.array([statistics.steps_to_reach(c.step, c.value, level) for c in cut])
        middle = float(np.median(steps))
        rows.append(
            {
                "group": name,
                "reached": f"{int(np.isfinite(steps).sum())} of {group.n}",
                "median step": middle if np.isfinite(middle) else np.nan,
                "first": float(steps.min()) if np.isfinite(steps).any() else np.nan,
            }
        )
    return pd.DataFrame(rows)
