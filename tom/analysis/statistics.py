"""Honest numbers over seeds and tasks, after Agarwal et al. 2021 (the rliable paper).

Scores are a matrix (runs, tasks): a row a seed, a column a task, NaN where a run is missing. A
statistic takes the tasks as separate samples, as `scipy.stats.bootstrap` gives them. Knows nothing
of runs on disk or of figures. To average over tasks, bring their scores onto one scale first.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import stats

Array = NDArray[np.float64]
Statistic = Callable[..., Array]

LEVEL = 0.95  # of every interval and band
RESAMPLES = 2000
ENOUGH = 10
"""Fewer seeds than this are called few."""

COVERAGE = {2: 51, 3: 74, 4: 79, 5: 84, 6: 85, 7: 87, 8: 89, 9: 89}
"""How many of 100 nominal 95 % intervals of n normal scores hold their true mean (measured)."""

_BATCH_NUMBERS = 4_000_000  # so many are resampled at once: bounds a bootstrap's memory


@dataclass(frozen=True)
class Interval:
    """A statistic and its bootstrap interval; the bounds are NaN where a task has one run."""

    value: float
    low: float
    high: float

    def __str__(self) -> str:
        bounds = f" [{self.low:.4g}, {self.high:.4g}]" if np.isfinite(self.low) else ""
        return f"{self.value:.4g}{bounds}"


@dataclass(frozen=True)
class Summary:
    """The three aggregates of a matrix of scores; `remark` says what they cannot carry."""

    runs: int
    tasks: int
    mean: Interval
    median: Interval
    iqm: Interval
    remark: str


def mean(*tasks: Array, axis: int = -1) -> Array:
    """Mean over tasks of the mean over runs."""
    return np.mean([task.mean(axis) for task in tasks], axis=0)


def median(*tasks: Array, axis: int = -1) -> Array:
    """Median over tasks of the mean over runs; where there is one task, median over its runs."""
    if len(tasks) == 1:
        return np.median(tasks[0], axis=axis)
    return np.median([task.mean(axis) for task in tasks], axis=0)


def iqm(*tasks: Array, axis: int = -1) -> Array:
    """Interquartile mean: the mean of the middle half of all runs of all tasks.

    A quarter of the scores, rounded down, is cut from either end: under four it is the mean.
    """
    return stats.trim_mean(np.concatenate(tasks, axis=axis), 0.25, axis=axis)


STATISTICS: dict[str, Statistic] = {"mean": mean, "median": median, "iqm": iqm}


def interval(
    scores: ArrayLike,
    statistic: Statistic,
    rng: np.random.Generator,
    resamples: int = RESAMPLES,
) -> Interval:
    """A statistic of `scores` (runs, tasks) with its stratified percentile bootstrap interval.

    Runs are resampled within each task, never across tasks. Raises ValueError without any score.
    """
    tasks = _columns(scores)
    value = float(statistic(*tasks))
    if min(map(len, tasks)) < 2:
        return Interval(value, np.nan, np.nan)
    low, high = _bootstrap(tasks, statistic, rng, resamples)
    return Interval(value, float(low), float(high))


def band(
    values: ArrayLike,
    statistic: Statistic,
    rng: np.random.Generator,
    resamples: int = RESAMPLES,
) -> tuple[Array, Array]:
    """The bootstrap interval at every point of curves (n, T): low (T,) and high (T,).

    All points share their resamples; NaN where n is 1.
    """
    curves = np.asarray(values, np.float64).T  # (T, n)
    if curves.shape[1] < 2:
        return np.full(len(curves), np.nan), np.full(len(curves), np.nan)
    return _bootstrap([curves], statistic, rng, resamples)


def summary(scores: ArrayLike, rng: np.random.Generator) -> Summary:
    """Mean, median and IQM of `scores` (runs, tasks) with intervals and what to bear in mind."""
    tasks = _columns(scores)
    found = {name: interval(scores, statistic, rng) for name, statistic in STATISTICS.items()}
    counts = [len(task) for task in tasks]
    return Summary(max(counts), len(tasks), **found, remark=remark(counts))


def performance_profile(scores: ArrayLike, thresholds: ArrayLike) -> Array:
    """Share of runs that score above each threshold (T,), averaged over tasks."""
    return _shares(np.asarray(thresholds, np.float64))(*_columns(scores))


def profile_band(
    scores: ArrayLike,
    thresholds: ArrayLike,
    rng: np.random.Generator,
    resamples: int = RESAMPLES,
) -> tuple[Array, Array]:
    """The bootstrap interval of `performance_profile`: low (T,) and high (T,), NaN for one run."""
    at, tasks = np.asarray(thresholds, np.float64), _columns(scores)
    if min(map(len, tasks)) < 2:
        return np.full(len(at), np.nan), np.full(len(at), np.nan)
    pairs = [_bootstrap(tasks, _shares(at[[i]]), rng, resamples) for i in range(len(at))]
    low, high = np.array(pairs)[:, :, 0].T
    return low, high


def probability_of_improvement(x: ArrayLike, y: ArrayLike, rng: np.random.Generator) -> Interval:
    """P(a run of X beats a run of Y), ties counting half, averaged over tasks.

    For one task it is Mann and Whitney's U over the number of pairs. `x` (runs, tasks) and `y`
    (other runs, tasks) hold the same tasks; ValueError otherwise.
    """
    ours, theirs = _columns(x), _columns(y)
    if len(ours) != len(theirs):
        raise ValueError(f"{len(ours)} tasks against {len(theirs)}: compare the same tasks")
    tasks = [*ours, *theirs]
    value = float(_wins(*tasks))
    if min(map(len, tasks)) < 2:
        return Interval(value, np.nan, np.nan)
    low, high = _bootstrap(tasks, _wins, rng, RESAMPLES)
    return Interval(value, float(low), float(high))


def steps_to_reach(step: ArrayLike, value: ArrayLike, level: float) -> float:
    """Sample efficiency: the first step at which a curve is at `level`; infinity if it never is.

    As infinity it enters a median over seeds as what it is: later than every run that got there.
    """
    reached = np.asarray(step)[np.asarray(value, np.float64) >= level]
    return float(reached[0]) if len(reached) else np.inf


def area_under_curve(step: ArrayLike, value: ArrayLike, until: float) -> float:
    """Mean height of a curve from its first step to step `until`, by the trapezoid rule.

    NaN for a curve that ends before `until`: it is never prolonged.
    """
    steps, values = np.asarray(step, np.float64), np.asarray(value, np.float64)
    if not len(steps) or steps[-1] < until or until <= steps[0]:
        return np.nan
    inside = steps < until
    x = np.append(steps[inside], until)
    y = np.append(values[inside], np.interp(until, steps, values))
    return float(np.trapezoid(y, x) / (until - steps[0]))


def running_maximum(value: ArrayLike) -> Array:
    """The best value so far at each point (T,): what the paper's return curves show."""
    return np.maximum.accumulate(np.asarray(value, np.float64))


def remark(runs: int | Sequence[int]) -> str:
    """What so few seeds cannot carry; empty from ten on. `runs`: seeds, or seeds of each task."""
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


def _columns(scores: ArrayLike) -> list[Array]:
    """The runs of each task, without the missing ones."""
    matrix = np.asarray(scores, np.float64)
    if matrix.ndim != 2:
        raise ValueError(f"scores must be (runs, tasks), not of shape {matrix.shape}")
    columns = [column[~np.isnan(column)] for column in matrix.T]
    if not columns or not all(map(len, columns)):
        raise ValueError("every task needs at least one run")
    return columns


def _bootstrap(
    tasks: Sequence[Array],
    statistic: Statistic,
    rng: np.random.Generator,
    resamples: int,
) -> tuple[Array, Array]:
    numbers = sum(task.size for task in tasks)
    found: Any = stats.bootstrap(
        tasks,
        statistic,
        n_resamples=resamples,
        batch=max(_BATCH_NUMBERS // numbers, 1),
        vectorized=True,
        axis=-1,
        confidence_level=LEVEL,
        method="percentile",
        rng=rng,
    )
    return found.confidence_interval.low, found.confidence_interval.high


def _shares(thresholds: Array) -> Statistic:
    """The statistic whose value at each threshold, in front, is the share of runs above it."""

    def shares(*tasks: Array, axis: int = -1) -> Array:
        at = [[(task > t).mean(axis) for t in thresholds] for task in tasks]
        return np.mean(at, axis=0)

    return shares


def _wins(*tasks: Array, axis: int = -1) -> Array:
    """The first half of `tasks` are X's, the other half Y's; runs on the last axis."""
    half = len(tasks) // 2
    each = []
    for x, y in zip(tasks[:half], tasks[half:], strict=True):
        gap = x[..., :, None] - y[..., None, :]
        each.append(((gap > 0) + 0.5 * (gap == 0)).mean((-2, -1)))
    return np.mean(each, axis=0)
