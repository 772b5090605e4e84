"""The tables of the returns study about fits: exams, rollouts in their models, wins in both."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from tom.analysis.scores import beats, chance, interval
from tom.analysis.statistics import corrected, remark
from tom.exams.counted import counted_from
from tom.exams.energy import informative
from tom.learners.base import HEAVY
from tom.studies.returns import Array, Cell, Method, compared_at, envs_of
from tom.studies.returns_tables import contests

FOOTPRINT, NOISE = "exam/footprint", "exam/footprint_noise"
EXAMS = {
    FOOTPRINT: "footprint",
    "exam/error": "error",
    "exam/rollout_error": "error after 5 steps",
}
"""the reported numbers of a learner's exams, by metric"""
FALLS, POLICY_FALLS = "rollout/terminated", "weights/ends_policy"
LARGEST, SIZE = "weights/max", "buffer/size"
ROLLOUTS = ("falls", "heavy rows")
"""the reported numbers of a learner's rollouts"""
COMPARED = (*EXAMS.values(), "falls")
"""the numbers in which learners are compared"""

Span = tuple[float, float]
"""the first and the last step whose fits count"""
OfFits = Callable[[pd.DataFrame, Span], Mapping[str, float] | None]


def exams(cells: Sequence[Cell]) -> list[dict[str, Any]]:
    """One row per environment and learner whose runs have exams: the median fit of each run.

    It has the mean over runs and its bootstrap interval (`tom.exams`). Only the fits from the step
    on from which every learner of the environment weighs (TOM must know its policy first) and up to
    the step that all runs reach count. A run none of whose footprints is informative is missing in
    their mean.
    """
    return _table(cells, _exam_medians)


def rollouts(cells: Sequence[Cell]) -> list[dict[str, Any]]:
    """One row per environment and learner: the rollouts that its runs' policies were trained on.

    Rows, means and intervals as those of `exams`. "falls": the share of rollout steps that end an
    episode over that of the policy's own last steps, the median fit of each run among those whose
    policy did fall; above 1 the rollouts fall more often than the policy. "heavy rows": the share
    of fits with a row that has HEAVY or more of the weight, and so of the rollouts' starts if those
    are drawn by weight.
    """
    return _table(cells, _rollouts)


def less(cells: Sequence[Cell], *, planned: bool = False) -> list[dict[str, Any]]:
    """How often a run of a learner has a smaller number of COMPARED than a run of another.

    The numbers are those of single runs that `exams` and `rollouts` have the means of. Pairs, p and
    its correction for the number of rows are those of `improvement`.
    """
    label = {cell.method: cell.label for cell in cells}
    numbers: dict[tuple[str, str, Method], list[float]] = {}
    for cell, told in [*_told(cells, _exam_medians), *_told(cells, _rollouts)]:
        for one in told:
            for name, value in one.items():
                if np.isfinite(value):
                    numbers.setdefault((name, cell.env, cell.method), []).append(value)
    rows = []
    for ours, theirs in contests(list(label), planned):
        for name in COMPARED:
            both = {
                env: [np.array(numbers[name, env, method]) for method in (ours, theirs)]
                for env in envs_of(cells)
                if all((name, env, method) in numbers for method in (ours, theirs))
            }
            if both:
                rows.append(_smaller(label[ours], label[theirs], name, both))
    ps = corrected([row["p"] for row in rows])
    return [row | {"p of all": p} for row, p in zip(rows, ps, strict=True)]


def _smaller(
    ours: str, theirs: str, name: str, both: Mapping[str, Sequence[Array]]
) -> dict[str, Any]:
    """One row; `both` are the numbers of either's runs, (n,) and (m,), by environment."""
    first, second = ([pair[i] for pair in both.values()] for i in (0, 1))
    smaller = beats(second, first)
    return {
        "learner": ours,
        "against": theirs,
        "in": name,
        "less": smaller.value,
        "low": smaller.low,
        "high": smaller.high,
        "p": chance(first, second),
        "tasks": " ".join(both),
        "remark": remark([min(map(len, pair)) for pair in both.values()]),
    }


def _told(
    cells: Sequence[Cell], of_fits: OfFits
) -> list[tuple[Cell, Sequence[Mapping[str, float]]]]:
    """What `of_fits` says of each cell's runs, if of any, over the fits that count."""
    since = {
        env: counted_from(of_run for cell in cells if cell.env == env for of_run in cell.metrics)
        for env in envs_of(cells)
    }
    at, found = compared_at(cells), []
    for cell in cells:
        span = since[cell.env], at[cell.env]
        if told := [one for of_run in cell.metrics if (one := of_fits(of_run, span)) is not None]:
            found.append((cell, told))
    return found


def _table(cells: Sequence[Cell], of_fits: OfFits) -> list[dict[str, Any]]:
    rows = []
    for cell, told in _told(cells, of_fits):
        row: dict[str, Any] = {"env": cell.env, "learner": cell.label, "n": len(told)}
        for name in told[0]:
            values = np.array([one[name] for one in told])
            mean = interval(values[np.isfinite(values)])
            row |= {name: mean.value, f"{name} low": mean.low, f"{name} high": mean.high}
        rows.append(row | {"remark": remark(len(told))})
    return rows


def _exam_medians(metrics: pd.DataFrame, span: Span) -> Mapping[str, float] | None:
    """Each of EXAMS, the median over the fits within `span`; None without exams there.

    A footprint counts if it is informative.
    """
    if not set(EXAMS) <= set(metrics):
        return None
    here = metrics[metrics["env_step"].between(*span)]
    values = {name: np.asarray(here[name], np.float64) for name in EXAMS}
    if not any(np.isfinite(of_fits).any() for of_fits in values.values()):
        return None
    tells = informative(here[NOISE]) if NOISE in here else np.zeros(len(here), np.bool_)
    values[FOOTPRINT] = values[FOOTPRINT][tells]
    return {EXAMS[name]: _median(of_fits) for name, of_fits in values.items()}


def _rollouts(metrics: pd.DataFrame, span: Span) -> Mapping[str, float] | None:
    """Each of ROLLOUTS over the fits within `span`; None if they recorded too little."""
    needed = [FALLS, POLICY_FALLS, LARGEST, SIZE]
    if not set(needed) <= set(metrics):
        return None
    here = metrics.loc[metrics["env_step"].between(*span), needed].dropna()
    if here.empty:
        return None
    falls = _median((here[FALLS] / here[POLICY_FALLS]).to_numpy())
    heavy = float((here[LARGEST] >= HEAVY * here[SIZE]).mean())
    return dict(zip(ROLLOUTS, (falls, heavy), strict=True))


def _median(of_fits: Array) -> float:
    """The median of the finite numbers; NaN without any."""
    finite = of_fits[np.isfinite(of_fits)]
    return float(np.median(finite)) if len(finite) else np.nan
