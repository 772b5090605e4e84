"""Statistics over recordings: the moments of one recording are no independent samples."""

from collections.abc import Iterable
from statistics import median

import numpy as np

from tom.analysis.statistics import Interval, draws, interval, mean

Value = tuple[str, str, float]
"""task, recording, and a value at one of its moments"""


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
