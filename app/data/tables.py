"""The tables of the comparison, to read. Pure functions."""

import math
from collections.abc import Iterable, Sequence

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from tom.analysis.curves import Group
from tom.analysis.scores import BEST, FINAL, common_step, interval, scores_of, steps_to
from tom.analysis.settings import differences
from tom.learners import learner_label
from tom.record.reader import RunReader

REACH = 0.8
"""the default level of `steps to reach`, as a share of the way from the worst to the best score"""


def summary(grouped: Sequence[Group]) -> pd.DataFrame:
    """One row per group: runs, the last step that all reach, final and best with intervals.

    Final and best are up to that step; NaN if a run began only after it.
    """
    rows = []
    for group in grouped:
        last = common_step(group.curves)
        row = {
            "environment": group.env,
            "learner": learner_label(group.learner),
            "preset": group.preset,
            "settings": group.variant,
            "n": group.n,
            "seeds": ", ".join(str(curve.seed) for curve in group.curves),
            "steps": last,
        }
        for name, score in (("final", FINAL), ("best", BEST)):
            over = interval(scores_of(group.curves, score, last), group.statistic)
            row |= {name: over.value, f"{name} low": over.low, f"{name} high": over.high}
        rows.append(row)
    return pd.DataFrame(rows)


def default_level(scores: NDArray[np.float64]) -> float:
    """A level that good runs reach and others may not, rounded down to a hundredth of the spread.

    If all scores are equal, it is that score.
    """
    low, high = float(scores.min()), float(scores.max())
    if high <= low:
        return low
    unit = 10.0 ** (2 - math.floor(math.log10(high - low)))
    return math.floor((low + REACH * (high - low)) * unit) / unit


def reached(
    grouped: Sequence[Group], names: Sequence[str], level: float, until: float
) -> pd.DataFrame:
    """For each group the number of runs that reach the level by step `until`, and the median step.

    Later steps do not count, because runs that ended earlier have none.
    """
    rows = []
    for name, group in zip(names, grouped, strict=True):
        steps = steps_to(group.curves, level, until)
        rows.append(
            {
                "group": name,
                "reached": f"{np.isfinite(steps).sum()} of {group.n}",
                "median step": float(np.median(steps)),
                "first": float(steps.min(initial=np.inf)),
            }
        )
    return pd.DataFrame(rows).replace(np.inf, np.nan)


def settings(runs: Sequence[RunReader], names: Iterable[str]) -> pd.DataFrame:
    """One row per setting in which the runs differ, one column per run by its name, all unlike."""
    frame = pd.DataFrame(differences(runs), index=pd.Index(names)).T
    return frame.rename_axis("setting").reset_index()
