"""The exams of runs' fits, and which learner has the lowest error in them. Pure functions.

An exam is the real steps between a fit and the next, which are not in its buffer.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from tom.analysis.curves import curve_points
from tom.analysis.scores import interval
from tom.analysis.statistics import RANKED, Interval, exchangeable, probability_of_improvement
from tom.exams import informative

Floats = NDArray[np.float64]

MEASURED = {
    "error": "exam/error",
    "rollout_error": "exam/rollout_error",
    "footprint": "exam/footprint",
    "noise": "exam/footprint_noise",
}


@dataclass(frozen=True)
class Exams:
    """The exams of a run's fits in order, (F,); NaN if a value was not measured.

    `returns` are those of the next evaluation. Runs of one `group` differ only in the seed.
    """

    run_id: str
    learner: str
    seed: int
    group: str
    step: NDArray[np.int64]
    error: Floats
    rollout_error: Floats
    footprint: Floats
    noise: Floats
    returns: Floats

    @property
    def informative(self) -> NDArray[np.bool_]:
        """A mask (F,) of the informative footprints."""
        return informative(self.noise)

    @property
    def last(self) -> float:
        """The step of the last examined fit; -inf if there is none."""
        return float(self.step[-1]) if len(self.step) else -np.inf

    def subset(self, which: NDArray) -> "Exams":
        """Some of the exams: a mask (F,) or indices."""
        names = ("step", *MEASURED, "returns")
        return replace(self, **{name: getattr(self, name)[which] for name in names})


def exams_of(run_id: str, learner: str, seed: int, group: str, frame: pd.DataFrame) -> Exams:
    """The exams in a run's metrics: `env_step` and every metric.

    The return is that of the first evaluation after a fit: at the fit's own step it is still that
    of the previous policy.
    """
    measured = frame.reindex(columns=list(MEASURED.values())).to_numpy(np.float64).T  # (4, rows)
    examined = np.isfinite(measured).any(0)
    step = np.asarray(frame["env_step"], np.int64)[examined]
    at, value = curve_points(frame, "eval/return")
    returns = np.append(value, np.nan)[np.searchsorted(at, step, side="right")]
    kept = dict(zip(MEASURED, measured[:, examined], strict=True))
    return Exams(run_id, learner, seed, group, step, **kept, returns=returns)


@dataclass(frozen=True)
class Standing:
    """The result of a group's exams: medians over each run's fits, (n,) for its runs."""

    name: str
    seeds: int
    fits: int
    error: Floats
    rollout_error: Floats
    footprint: Floats
    informative_fits: int
    """number of fits with an informative footprint"""

    @property
    def typical(self) -> float:
        """The interquartile mean of the runs' errors; NaN if there are none."""
        return interval(self.error, "iqm").value


@dataclass(frozen=True)
class Ranking:
    """The groups of the runs, and a ranking by error of those with enough seeds."""

    standings: tuple[Standing, ...]
    since: float
    """the first step whose fits count (`counted_from`); -infinity if no run weighs"""
    until: float
    """the last step whose fits count; infinity if no error was measured"""
    ranked: tuple[Standing, ...]
    """by ascending error; empty if fewer than two groups have enough seeds"""

    def ended_before(self, run: Exams) -> bool:
        """Whether a run does not count, because its last examined fit is before step `until`."""
        return run.last < self.until < np.inf

    @property
    def first_beats_second(self) -> Interval:
        """P(a run of the first ranked group has a lower error than one of the second)."""
        first, second = (-standing.error for standing in self.ranked[:2])
        return probability_of_improvement([first], [second])

    @property
    def p_value(self) -> float:
        """The p of `first_beats_second`: by permutation, since the interval is for many runs."""
        first, second = (standing.error for standing in self.ranked[:2])
        return exchangeable([first], [second])


def ranking(exams: Sequence[Exams], since: float = -np.inf) -> Ranking:
    """Rank the groups with at least `RANKED` seeds, over the steps that so many of each reach.

    The fits before step `since` do not count (`counted_from`), unless no others are left.
    Runs that end earlier are left out, because their fits saw less data. If fewer than two groups
    have enough seeds, the steps are those that every run reaches.
    """
    groups: dict[str, list[Exams]] = {}
    for one in exams:
        groups.setdefault(one.group, []).append(one)
    reach = {name: reached for name, of in groups.items() if np.isfinite(reached := reach_of(of))}
    lasts = [one.last for one in exams if np.isfinite(one.error).any()]
    until = min(reach.values() if len(reach) > 1 else lasts, default=np.inf)
    since = since if since <= until else -np.inf
    standings = {}
    for name, of in groups.items():
        whole = [run for run in of if np.isinf(until) or run.last >= until]
        counted = [run.subset((run.step >= since) & (run.step <= until)) for run in whole]
        standings[name] = standing(name, counted)
    ranked = [standings[name] for name in reach] if len(reach) > 1 else []
    ranked.sort(key=lambda one: one.typical)
    return Ranking(tuple(standings.values()), since, until, tuple(ranked))


def reach_of(runs: Sequence[Exams]) -> float:
    """The last examined step that `RANKED` seeds reach; -inf if there are fewer seeds."""
    last = last_steps((run.seed, run.last) for run in runs if np.isfinite(run.error).any())
    return last[-RANKED] if len(last) >= RANKED else -np.inf


def last_steps(ends: Iterable[tuple[int, float]]) -> list[float]:
    """Of the seed and the last step of each run: how far each seed got, ascending."""
    last: dict[int, float] = {}
    for seed, step in ends:
        last[seed] = max(last.get(seed, -np.inf), step)
    return sorted(last.values())


def standing(group: str, runs: Sequence[Exams]) -> Standing:
    return Standing(
        group,
        len({run.seed for run in runs}),
        sum(len(run.step) for run in runs),
        medians([run.error for run in runs]),
        medians([run.rollout_error for run in runs]),
        medians([run.footprint[run.informative] for run in runs]),
        sum(int(run.informative.sum()) for run in runs),
    )


def medians(runs: Sequence[Floats]) -> Floats:
    """The median of each run's numbers, without the runs that have none."""
    finite = [values[np.isfinite(values)] for values in runs]
    return np.array([np.median(values) for values in finite if len(values)], np.float64)


def at_fit(frame: pd.DataFrame, step: int) -> Mapping[str, float]:
    """The exam metrics of the fit at `step`; empty if it has no exam."""
    here = frame[frame["env_step"] == step].filter(like="exam/")
    values = {str(name): float(value) for name in here for value in here[name]}
    return {name: value for name, value in values.items() if np.isfinite(value)}
