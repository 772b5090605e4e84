"""Statistics over recordings: the moments of one recording are no independent samples."""

from collections.abc import Iterable
from dataclasses import dataclass
from statistics import median

import numpy as np
from scipy.stats import binomtest

from tom.analysis.statistics import Interval, draws, interval, mean

Value = tuple[str, str, float]
"""task, recording, and a value at one of its moments"""


@dataclass(frozen=True)
class Signs:
    """On how many of `n` recordings a difference is above zero, and the sign test's p."""

    above: int
    n: int
    p: float

    @property
    def below(self) -> int:
        return self.n - self.above


def sign_test(differences: Iterable[Value]) -> Signs:
    """Exact two-sided sign test over recordings; one counts by most of its moments.

    Recordings with as many moments above as below zero do not count. Unlike a bootstrap interval it
    is right for few recordings.
    """
    of: dict[tuple[str, str], int] = {}
    for env, recording, value in differences:
        sign = (value > 0) - (value < 0)
        of[env, recording] = of.get((env, recording), 0) + sign
    above, n = sum(v > 0 for v in of.values()), sum(v != 0 for v in of.values())
    return Signs(above, n, float(binomtest(above, n).pvalue) if n else 1.0)


def over_recordings(values: Iterable[Value]) -> Interval:
    """Mean over tasks of the mean over recordings of the median over moments.

    The bootstrap interval resamples recordings within each task; its bounds are NaN if a task has
    only one. Raises ValueError if there is no value.
    """
    moments: dict[str, dict[str, list[float]]] = {}
    for env, recording, value in values:
        moments.setdefault(env, {}).setdefault(recording, []).append(value)
    tasks = [[median(of) for of in recordings.values()] for recordings in moments.values()]
    scores = np.full((max(map(len, tasks), default=0), len(tasks)), np.nan)
    for column, of in enumerate(tasks):
        scores[: len(of), column] = of
    return interval(scores, mean, draws())
