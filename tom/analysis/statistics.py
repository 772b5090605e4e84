"""Statistics over seeds and tasks, after Agarwal et al. 2021 (the rliable paper).

Scores are one array of runs for each task, NaN for a missing run. A statistic takes the tasks as
separate samples. To average over tasks, bring their scores onto one scale first. All draws are of
one fixed seed: the same scores have the same interval everywhere. This module knows neither run
folders nor figures, and not `scipy.stats`, which takes a second to import.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Scores = Sequence[ArrayLike] | NDArray[Any]
Statistic = Callable[..., Array]

LEVEL = 0.95  # of every interval and band
RESAMPLES = 2000
SIGNIFICANT = 0.05
"""the p below which two groups are said to differ"""
ENOUGH = 10
"""With fewer seeds than this a result carries a remark."""
RANKED = 5
"""Groups with fewer seeds than this are not ranked."""

COVERAGE = {2: 51, 3: 74, 4: 79, 5: 84, 6: 85, 7: 87, 8: 89, 9: 89}
"""Measured coverage, in percent, of nominal 95 % intervals of n normal scores."""

_BATCH_NUMBERS = 4_000_000  # resampled at once, which bounds a bootstrap's memory


@dataclass(frozen=True)
class Interval:
    """A statistic and its bootstrap interval; the bounds are NaN if a task has only one run."""

    value: float
    low: float
    high: float

    def columns(self, name: str, of: str = "") -> dict[str, float]:
        """The value under its name in a table, and its bounds, under `of` low and high."""
        return {name: self.value, f"{of} low".lstrip(): self.low, f"{of} high".lstrip(): self.high}

    def __str__(self) -> str:
        bounds = f" [{self.low:.4g}, {self.high:.4g}]" if np.isfinite(self.low) else ""
        return f"{self.value:.4g}{bounds}"


def mean(*tasks: Array, axis: int = -1) -> Array:
    """Mean over tasks of the mean over runs."""
    return np.mean([task.mean(axis) for task in tasks], axis=0)


def median(*tasks: Array, axis: int = -1) -> Array:
    """Median over tasks of the mean over runs; for a single task, the median over its runs."""
    if len(tasks) == 1:
        return np.median(tasks[0], axis=axis)
    return np.median([task.mean(axis) for task in tasks], axis=0)


def iqm(*tasks: Array, axis: int = -1) -> Array:
    """Interquartile mean: the mean of the middle half of all runs of all tasks.

    A quarter of the scores, rounded down, is cut at each end; with fewer than four it is the mean.
    """
    runs = np.moveaxis(np.concatenate(tasks, axis=axis), axis, -1)
    cut = runs.shape[-1] // 4
    ends = cut, runs.shape[-1] - cut
    return np.partition(runs, (ends[0], ends[1] - 1), -1)[..., slice(*ends)].mean(-1)


STATISTICS: dict[str, Statistic] = {"mean": mean, "median": median, "iqm": iqm}


def interval(scores: Scores, statistic: Statistic, resamples: int = RESAMPLES) -> Interval:
    """A statistic of scores with its stratified percentile bootstrap interval.

    Runs are resampled within each task, never across tasks. Raises ValueError if there is no score.
    """
    tasks = _tasks(scores)
    low, high = _bootstrap(tasks, statistic, resamples)
    return Interval(float(statistic(*tasks)), float(low), float(high))


def band(
    values: ArrayLike, statistic: Statistic, resamples: int = RESAMPLES
) -> tuple[Array, Array]:
    """The bootstrap interval at every point of curves (n, T): low (T,) and high (T,).

    All points share their resamples; NaN if n is 1.
    """
    return _bootstrap([np.asarray(values, np.float64).T], statistic, resamples)


def performance_profile(scores: Scores, thresholds: ArrayLike) -> Array:
    """Share of runs that score above each threshold (T,), averaged over tasks."""
    return _shares(np.asarray(thresholds, np.float64))(*_tasks(scores))


def profile_band(
    scores: Scores, thresholds: ArrayLike, resamples: int = RESAMPLES
) -> tuple[Array, Array]:
    """The bootstrap interval of `performance_profile`: low (T,) and high (T,), NaN for one run.

    All thresholds have the same resamples, so that the band never rises.
    """
    return _bootstrap(_tasks(scores), _shares(np.asarray(thresholds, np.float64)), resamples)


def probability_of_improvement(x: Scores, y: Scores) -> Interval:
    """P(a run of X beats a run of Y), ties counting half, averaged over tasks.

    For one task it is Mann and Whitney's U divided by the number of pairs. X and Y must have the
    same tasks, else ValueError.
    """
    if len(x) != len(y):
        raise ValueError(f"{len(x)} tasks against {len(y)}: compare the same tasks")
    return interval([*x, *y], _wins)


def exchangeable(x: Scores, y: Scores) -> float:
    """The two-sided p of `probability_of_improvement`: Mann and Whitney's test by permutation.

    Were X and Y one method, their runs could change places within each task. p is the share of all
    such arrangements in which the probability is at least as far from a half; it is exact, with
    ties and few runs, too. Errors as there.
    """
    ours, theirs = _tasks(x), _tasks(y)
    wins, share = np.zeros(1), np.ones(1)
    for a, b in zip(ours, theirs, strict=True):
        of_task, chance = _wins_by_chance(np.concatenate([a, b]), len(a))
        sums, index = np.unique(np.round(wins[:, None] + of_task, 9), return_inverse=True)
        share = np.bincount(index.ravel(), (share[:, None] * chance).ravel())
        wins = sums
    away = np.abs(wins / len(ours) - 0.5)
    observed = abs(float(_wins(*ours, *theirs)) - 0.5)
    return min(float(share[away > observed - 1e-8].sum()), 1.0)


def _wins_by_chance(scores: Array, n: int) -> tuple[Array, Array]:
    """Each P(a run of n beats one of the others) that an arrangement of runs (N,) can give, and
    its share of all arrangements."""
    _, place, ties = np.unique(scores, return_inverse=True, return_counts=True)
    ranks = (2 * np.cumsum(ties) - ties + 1)[place]  # doubled: ties have half ranks
    ways = np.zeros((n + 1, int(ranks.sum()) + 1))  # to take k runs whose ranks have this sum
    ways[0, 0] = 1
    for rank in ranks:
        ways[1:, rank:] += ways[:-1, : ways.shape[1] - rank]
    sums = np.flatnonzero(ways[n])
    wins = (sums / 2 - n * (n + 1) / 2) / (n * (len(scores) - n))
    return wins, ways[n, sums] / ways[n].sum()


def corrected(ps: Sequence[float]) -> list[float]:
    """The p of several tests, corrected for their number by Holm's step-down method (1979).

    With these, chance alone makes one of them 5 % or less in at most 5 % of all cases, whether or
    not the tests depend on each other.
    """
    order = np.argsort(ps)
    by_size = np.asarray(ps, np.float64)[order] * np.arange(len(ps), 0, -1)
    result = np.empty(len(ps))
    result[order] = np.minimum(np.maximum.accumulate(by_size), 1)
    return result.tolist()


def remark(runs: int | Sequence[int]) -> str:
    """A warning if there are fewer than ten seeds. `runs`: seeds, or the seeds of each task."""
    n = min(runs, default=0) if isinstance(runs, Sequence) else runs
    if n == 0:
        return "no runs"
    if n == 1:
        return "1 seed: no interval, and no word on who is better"
    if n >= ENOUGH:
        return ""
    return (
        f"{n} seeds are few: about {COVERAGE[n]} of 100 such intervals hold the true mean, not 95"
    )


def _tasks(scores: Scores) -> list[Array]:
    """The runs of each task, without the missing ones."""
    every = [np.asarray(task, np.float64) for task in scores]
    tasks = [task[~np.isnan(task)] for task in every]
    if not tasks or not all(map(len, tasks)):
        raise ValueError("every task needs at least one run")
    return tasks


def _bootstrap(tasks: Sequence[Array], statistic: Statistic, resamples: int) -> tuple[Array, Array]:
    """The percentile interval of a statistic of tasks (..., runs): NaN if one has a single run."""
    if min(task.shape[-1] for task in tasks) < 2:
        nothing = np.full(np.shape(statistic(*tasks)), np.nan)
        return nothing, nothing
    batch = max(_BATCH_NUMBERS // sum(task.size for task in tasks), 1)
    rng, found = np.random.default_rng(0), []
    for first in range(0, resamples, batch):
        count = min(batch, resamples - first)
        drawn = [rng.integers(0, task.shape[-1], (count, task.shape[-1])) for task in tasks]
        resampled = [task[..., index] for task, index in zip(tasks, drawn, strict=True)]
        found.append(statistic(*resampled, axis=-1))
    ends = (1 - LEVEL) / 2, 1 - (1 - LEVEL) / 2
    low, high = np.quantile(np.concatenate(found, -1), ends, axis=-1)
    return low, high


def _shares(thresholds: Array) -> Statistic:
    """A statistic: the share of runs above each threshold, thresholds on the first axis."""

    def shares(*tasks: Array, axis: int = -1) -> Array:
        at = [[(task > t).mean(axis) for t in thresholds] for task in tasks]
        return np.mean(at, axis=0)

    return shares


def _wins(*tasks: Array, axis: int = -1) -> Array:
    """The first half of `tasks` belongs to X, the second half to Y; runs on the last axis."""
    half = len(tasks) // 2
    each = []
    for x, y in zip(tasks[:half], tasks[half:], strict=True):
        gap = x[..., :, None] - y[..., None, :]
        each.append(((gap > 0) + 0.5 * (gap == 0)).mean((-2, -1)))
    return np.mean(each, axis=0)
