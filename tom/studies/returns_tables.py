"""The tables of the returns study: scores, wins, and what the store lacks."""

from collections.abc import Collection, Mapping, Sequence
from itertools import combinations
from typing import Any

import numpy as np

from tom.analysis.scores import BEST, FINAL, HEIGHT, beats, chance, interval, steps_to
from tom.analysis.statistics import corrected, remark
from tom.envs import task
from tom.learners import LEARNER_NAMES, LEARNERS
from tom.studies.returns import (
    PAPER_ENVS,
    Array,
    Cell,
    Method,
    cell_of,
    compared_at,
    compared_from,
    envs_of,
)

PAPER_SEEDS = 4
RIVAL = "mle"
MEASURES = {BEST: "best return", FINAL: "last return", HEIGHT: "area under the curve"}
"""the scores by which learners are compared, in words"""


def summary(cells: Sequence[Cell]) -> list[dict[str, Any]]:
    """One row per environment and learner; scores are best returns up to the common step.

    Areas begin at the first step from which on all runs of the environment have returns.
    """
    at, since, rows = compared_at(cells), compared_from(cells), []
    for cell in cells:
        step = at[cell.env]
        scores = cell.scores(step)
        mean, iqm = interval(scores), interval(scores, "iqm")
        area = interval(cell.scores(step, HEIGHT, since[cell.env]))
        rival = cell_of(cells, cell.env, RIVAL)
        target = float(rival.scores(step).mean()) if rival else np.nan
        steps = steps_to(cell.curves, target, step)
        rows.append(
            {
                "env": cell.env,
                "learner": cell.label,
                "n": cell.n,
                "seeds": " ".join(map(str, cell.seeds)),
                "at step": int(step),
                "mean": mean.value,
                "low": mean.low,
                "high": mean.high,
                "median": interval(scores, "median").value,
                "IQM": iqm.value,
                "IQM low": iqm.low,
                "IQM high": iqm.high,
                "final": interval(cell.scores(step, FINAL)).value,
                "area": area.value,
                "area low": area.low,
                "area high": area.high,
                "steps to MLE's": float(np.median(steps)) if rival else np.nan,
                "reach": int(cell.reach),
                "paper's steps": task(cell.env).steps,
                "remark": remark(cell.n),
            }
        )
    return rows


def improvement(
    cells: Sequence[Cell], by: Collection[str] = MEASURES, *, planned: bool = False
) -> list[dict[str, Any]]:
    """How often a run of a learner beats a run of another, over the tasks that both have.

    Every learner against MLE, and TOM against every other; if `planned`, because the reader chose
    the learners, each against each. By some of MEASURES (an area is the
    curve's mean height). "p" is by permutation of the runs, since intervals of so few are too
    narrow, and "p of all" is corrected for the number of rows.
    """
    label = {cell.method: cell.label for cell in cells}
    at, since, rows = compared_at(cells), compared_from(cells), []
    spans = {env: (at[env], since[env]) for env in at}
    for ours, theirs in contests(list(label), planned):
        pairs = _pairs(cells, ours, theirs)
        if pairs:
            rows += [_wins(label[ours], label[theirs], pairs, spans, each) for each in by]
    ps = corrected([row["p"] for row in rows])
    return [row | {"p of all": p} for row, p in zip(rows, ps, strict=True)]


def contests(methods: Sequence[Method], planned: bool) -> list[tuple[Method, Method]]:
    """Each pair of methods, once, if not `planned` with MLE or TOM among them.

    Who is asked about stands first.
    """
    ranks = {RIVAL: 0, "tom": 2}
    order = sorted(methods, key=lambda method: (ranks.get(method[0], 1), *method))
    pairs = [(ours, theirs) for theirs, ours in combinations(order, 2)]
    told = [pair for pair in pairs if planned or ranks.keys() & {learner for learner, _ in pair}]
    return sorted(told, key=lambda pair: order.index(pair[0]))


def _pairs(cells: Sequence[Cell], ours: Method, theirs: Method) -> dict[str, tuple[Cell, Cell]]:
    """The scores of both by task, for tasks in which both have runs."""
    both = {
        env: (cell_of(cells, env, *ours), cell_of(cells, env, *theirs)) for env in envs_of(cells)
    }
    return {env: (one, other) for env, (one, other) in both.items() if one and other}


def _wins(
    ours: str,
    theirs: str,
    pairs: Mapping[str, tuple[Cell, Cell]],
    spans: Mapping[str, tuple[float, float]],
    by: str,
) -> dict[str, Any]:
    """One row; `spans` are the last and the first step of the comparison in each task."""

    def scores(cell: Cell) -> Array:
        until, since = spans[cell.env]
        return cell.scores(until, by, since)

    first = [scores(one) for one, _ in pairs.values()]
    second = [scores(other) for _, other in pairs.values()]
    wins = beats(first, second)
    return {
        "learner": ours,
        "against": theirs,
        "by": MEASURES[by],
        "wins": wins.value,
        "low": wins.low,
        "high": wins.high,
        "p": chance(first, second),
        "tasks": " ".join(pairs),
        "remark": remark([min(one.n, other.n) for one, other in pairs.values()]),
    }


def missing(cells: Sequence[Cell], envs: Sequence[str], learners: Sequence[str]) -> list[dict]:
    """The paper's seeds and steps that the store lacks, with the command that adds them."""
    rows = []
    for env in (env for env in envs if env in PAPER_ENVS):
        for learner in (name for name in learners if name in LEARNER_NAMES):
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
