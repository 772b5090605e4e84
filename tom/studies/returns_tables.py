"""The tables of the returns study: scores, exams, rollouts, who beats whom, effects of weights."""

from collections.abc import Collection, Mapping, Sequence

import numpy as np
import pandas as pd

from tom.analysis.scores import (
    BEST,
    FINAL,
    HEIGHT,
    common_step,
    contrast,
    counted_from,
    interval,
    steps_to,
)
from tom.analysis.settings import affects_results, changed, differing_settings
from tom.analysis.statistics import (
    corrected,
    exchangeable,
    probability_of_improvement,
    remark,
)
from tom.envs import task
from tom.exams import informative
from tom.learners import LEARNERS
from tom.learners.base import HEAVY
from tom.studies.returns_cells import (
    PAPER_ENVS,
    Array,
    Cell,
    cell_of,
)
from tom.studies.study import Row

PAPER_SEEDS = 4
RIVAL = "mle"
MEASURES = {BEST: "best return", FINAL: "last return", HEIGHT: "area under the curve"}
"""the scores by which learners are compared, in words"""

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

UNIFORM_MODEL, UNIFORM_STARTS = "model.uniform_share", "rollout.uniform_share"
"""the settings that make one place uniform, if they are 1"""
EFFECTS = {
    "weighted model": (1, 1, -1, -1),
    "weighted starts": (1, -1, 1, -1),
    "both beyond their sum": (1, -1, -1, 1),
}
"""what the cells add to an effect: those with weights in both places, in the model, in the starts,
in neither"""


def summary(cells: Sequence[Cell]) -> list[Row]:
    """One row per environment and learner; scores are best returns up to the common step.

    Areas begin at the first step from which on all runs of the environment have returns.
    """
    rows = []
    for cell in cells:
        scores, rival = cell.scores(), cell_of(cells, cell.env, RIVAL)
        target = float(rival.scores().mean()) if rival else np.nan
        steps = steps_to(cell.curves, target, cell.at)
        rows.append(
            {
                "env": cell.env,
                "learner": cell.label,
                "n": cell.n,
                "seeds": " ".join(map(str, cell.seeds)),
                "at step": int(cell.at),
                **interval(scores).columns("mean"),
                "median": interval(scores, "median").value,
                **interval(scores, "iqm").columns("IQM", "IQM"),
                "final": interval(cell.scores(FINAL)).value,
                **interval(cell.scores(HEIGHT)).columns("area", "area"),
                "steps to MLE's": float(np.median(steps)) if rival else np.nan,
                "reach": int(common_step(cell.curves)),
                "paper's steps": task(cell.env).steps,
                "remark": remark(cell.n),
            }
        )
    return rows


def improvement(
    cells: Sequence[Cell], by: Collection[str] = MEASURES, *, planned: bool = False
) -> list[Row]:
    """How often a run of a learner beats a run of another, over the tasks that both have.

    Every learner against MLE, and TOM against every other; if `planned`, because the reader chose
    the learners, each against each. By some of MEASURES (an area is the curve's mean height).
    """
    numbers = {MEASURES[score]: {cell: cell.scores(score) for cell in cells} for score in by}
    return _contests(cells, numbers, "by", "wins", planned)


def less(cells: Sequence[Cell], *, planned: bool = False) -> list[Row]:
    """How often a run of a learner has a smaller number of COMPARED than a run of another.

    The numbers are those of single runs that `exams` and `rollouts` have the means of. Pairs, p and
    its correction are those of `improvement`.
    """
    numbers: dict[str, dict[Cell, Array]] = {name: {} for name in COMPARED}
    for cell, every in _numbers(cells).items():
        for name in COMPARED:
            values = np.array([one.get(name, np.nan) for one in every])
            if np.isfinite(values).any():
                numbers[name][cell] = values[np.isfinite(values)]
    return _contests(cells, numbers, "in", "less", planned)


def _contests(
    cells: Sequence[Cell],
    numbers: Mapping[str, Mapping[Cell, Array]],
    titled: str,
    wins: str,
    planned: bool,
) -> list[Row]:
    """One row for each pair of learners and each of `numbers`, which are those of single runs.

    The pairs are those with MLE or TOM among them, if not `planned`; who is asked about stands
    first. "p" is by permutation of the runs, since intervals of so few are too narrow, and "p of
    all" is corrected for the number of rows. If `wins` is "less", the smaller number wins.
    """
    ranks, rows = {RIVAL: 0, "tom": 2}, []
    order = {
        cell.label: cell.learner
        for cell in sorted(cells, key=lambda c: (ranks.get(c.learner, 1), c.learner, c.variant))
    }
    pairs = [(ours, theirs) for i, ours in enumerate(order) for theirs in list(order)[:i]]
    for ours, theirs in pairs:
        if not (planned or ranks.keys() & {order[ours], order[theirs]}):
            continue
        for name, of in numbers.items():
            both = {
                one.env: (of[one], of[other])
                for one in of
                for other in of
                if (one.env, one.label, other.label) == (other.env, ours, theirs)
            }
            if not both:
                continue
            first, second = ([pair[i] for pair in both.values()] for i in (0, 1))
            sides = (second, first) if wins == "less" else (first, second)
            won = probability_of_improvement(*sides)
            rows.append(
                {
                    "learner": ours,
                    "against": theirs,
                    titled: name,
                    **won.columns(wins),
                    "p": exchangeable(first, second),
                    "tasks": " ".join(both),
                    "remark": remark([min(map(len, pair)) for pair in both.values()]),
                }
            )
    ps = corrected([row["p"] for row in rows])
    return [row | {"p of all": p} for row, p in zip(rows, ps, strict=True)]


def factors(cells: Sequence[Cell], measures: Collection[str] = MEASURES) -> list[Row]:
    """What weights do in the model and in the starts: the 2 x 2, where all four cells have runs.

    A learner's weights act in two places: the fit of the model (Algorithm 2, lines 15-18) and the
    start states of its rollouts (line 22). A uniform share of 1 makes one of them even; without
    any weights the learner is MLE. The effect of a place is the mean over both levels of the other.

    "p" is that of `exchangeable` with the other place's levels kept apart, and "p of all" is
    corrected for the number of rows that have one; the interaction has none, nor has a cell of one
    run.
    """
    rows = []
    for four in _designs(cells):
        env, few = four[0].env, remark([cell.n for cell in four])
        for by in measures:
            scores = [cell.scores(by) for cell in four]
            for name, signs in EFFECTS.items():
                row = {"env": env, "learner": four[0].label, "effect of": name, "by": MEASURES[by]}
                rows.append({**row, **_effect(scores, signs), "remark": few})
    tested = iter(corrected([row["p"] for row in rows if np.isfinite(row["p"])]))
    return [row | {"p of all": next(tested) if np.isfinite(row["p"]) else np.nan} for row in rows]


def _effect(scores: Sequence[Array], signs: Sequence[int]) -> Row:
    """An effect, and of a place how often a run with weights there beats one without."""
    of_place = sum(signs[1:3]) == 0
    effect = contrast(scores, [sign / 2 if of_place else sign for sign in signs])
    row: Row = {"wins": np.nan, "p": np.nan, **effect.columns("effect")}
    if of_place:
        # In pairs that are alike in the other place.
        up, down = (
            [of for of, sign in zip(scores, signs, strict=True) if sign == level]
            for level in (1, -1)
        )
        row["wins"] = probability_of_improvement(up, down).value
        if min(map(len, scores)) > 1:
            row["p"] = exchangeable(up, down)
    return row


def _designs(cells: Sequence[Cell]) -> list[tuple[Cell, Cell, Cell, Cell]]:
    """The cells with weights in both places, in the model, in the starts, and in neither."""
    found, settings = [], {cell: changed(cell.runs[0]) for cell in cells}
    for both in (cell for cell in cells if cell.learner != RIVAL):
        if "1.0" in map(settings[both].get, (UNIFORM_MODEL, UNIFORM_STARTS)):
            continue
        here = [cell for cell in cells if cell.env == both.env]
        # Those that differ in uniform weights in one place alone.
        model, starts = (
            [
                cell
                for cell in here
                if (cell.learner, cell.runs[0].preset) == (both.learner, both.runs[0].preset)
                and settings[cell] == {**settings[both], place: "1.0"}
            ]
            for place in (UNIFORM_STARTS, UNIFORM_MODEL)
        )
        # MLE with the same settings but for the learner's own.
        neither = [
            cell
            for cell in here
            if cell.learner == RIVAL
            and not any(
                affects_results(p, RIVAL) for p in differing_settings([cell.runs[0], both.runs[0]])
            )
        ]
        if model and starts and neither:
            found.append((both, model[0], starts[0], neither[0]))
    return found


def exams(cells: Sequence[Cell]) -> list[Row]:
    """One row per environment and learner whose runs have exams: the median fit of each run.

    It has the mean over runs and its bootstrap interval (`tom.exams`). Only the fits from the step
    on from which every learner of the environment weighs (TOM must know its policy first) and up to
    the step that all runs reach count. A run none of whose footprints is informative is missing in
    their mean.
    """
    return _table(cells, tuple(EXAMS.values()))


def rollouts(cells: Sequence[Cell]) -> list[Row]:
    """One row per environment and learner: the rollouts that its runs' policies were trained on.

    Rows, means and intervals as those of `exams`. "falls": the share of rollout steps that end an
    episode over that of the policy's own last steps, the median fit of each run among those whose
    policy did fall; above 1 the rollouts fall more often than the policy. "heavy rows": the share
    of fits with a row that has HEAVY or more of the weight, and so of the rollouts' starts if those
    are drawn by weight.
    """
    return _table(cells, ROLLOUTS)


def _table(cells: Sequence[Cell], names: Sequence[str]) -> list[Row]:
    rows = []
    for cell, every in _numbers(cells).items():
        recorded = [one for one in every if names[0] in one]
        if not recorded:
            continue
        row: Row = {"env": cell.env, "learner": cell.label, "n": len(recorded)}
        for name in names:
            values = np.array([one[name] for one in recorded])
            row |= interval(values[np.isfinite(values)]).columns(name, name)
        rows.append(row | {"remark": remark(len(recorded))})
    return rows


def _numbers(cells: Sequence[Cell]) -> dict[Cell, list[dict[str, float]]]:
    """What the fits of each cell's runs come to, over the fits that count, as far as recorded."""
    found = {}
    since = {
        env: counted_from(one.metrics for c in cells if c.env == env for one in c.recorded)
        for env in {cell.env for cell in cells}
    }
    for cell in cells:
        counted = since[cell.env], cell.at
        found[cell] = [
            _of_run(one.metrics.loc[one.metrics["env_step"].between(*counted)])
            for one in cell.recorded
        ]
    return found


def _of_run(fits: pd.DataFrame) -> dict[str, float]:
    """EXAMS and ROLLOUTS of a run's fits, each a median, a footprint of those informative."""
    found: dict[str, float] = {}
    if set(EXAMS) <= set(fits) and np.isfinite(fits[list(EXAMS)].to_numpy(np.float64)).any():
        noise = fits[NOISE] if NOISE in fits else np.full(len(fits), np.nan)
        counts = {FOOTPRINT: informative(noise)}
        every = np.ones(len(fits), np.bool_)
        found = {
            name: _median(np.asarray(fits[of], np.float64)[counts.get(of, every)])
            for of, name in EXAMS.items()
        }
    needed = [FALLS, POLICY_FALLS, LARGEST, SIZE]
    if set(needed) <= set(fits) and not (here := fits.loc[:, needed].dropna()).empty:
        found["falls"] = _median((here[FALLS] / here[POLICY_FALLS]).to_numpy())
        found["heavy rows"] = float((here[LARGEST] >= HEAVY * here[SIZE]).mean())
    return found


def _median(of_fits: Array) -> float:
    """The median of the finite numbers; NaN without any."""
    finite = of_fits[np.isfinite(of_fits)]
    return float(np.median(finite)) if len(finite) else np.nan


def missing(cells: Sequence[Cell], envs: Sequence[str], learners: Sequence[str]) -> list[Row]:
    """The paper's seeds and steps that the store lacks, with the command that adds them."""
    rows = []
    for env in (env for env in envs if env in PAPER_ENVS):
        for learner in (name for name in learners if LEARNERS[name].own is None):
            cell, steps = cell_of(cells, env, learner), task(env).steps
            full = [c for c in cell.curves if c.step[-1] >= steps] if cell else []
            if len(full) < PAPER_SEEDS:
                seeds = " ".join(map(str, range(PAPER_SEEDS)))
                wanted = f"--env {env} --learner {learner} --preset paper --seeds {seeds}"
                rows.append(
                    {
                        "env": env,
                        "learner": LEARNERS[learner].label,
                        "runs of full length": f"{len(full)} of {PAPER_SEEDS}",
                        "longest": int(cell.longest) if cell else 0,
                        "of": steps,
                        "command": f"tom sweep {wanted}",
                    }
                )
    return rows
