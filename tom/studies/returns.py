"""Returns of every learner in every environment, from the runs in a store.

A run belongs to its environment, learner, preset and seed; a learner with another than the first
requested preset counts as a separate learner ("TOM, mended"). If runs differ in other settings, the
largest group of each learner is used, and in it the longest run of each seed. The learners of an
environment are compared at a step that all their runs reach; if the settings of their groups
differ, the verdict says so. Runs are grouped and scored as on the Compare page
(`tom/analysis/scores.py`).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tom.analysis.curves import Curve, curve_points
from tom.analysis.grouping import Kind, kinds
from tom.analysis.scores import (
    BEST,
    FINAL,
    HEIGHT,
    beats,
    begun,
    common_step,
    interval,
    scores_of,
    steps_to,
)
from tom.analysis.settings import unlike
from tom.analysis.statistics import remark
from tom.envs import ENVS, task
from tom.learners import LEARNER_NAMES, LEARNERS
from tom.record import RunReader

Array = NDArray[np.float64]
Recorded = tuple[RunReader, Curve]
PAPER_SEEDS = 4
PAPER_ENVS = tuple(name for name, env in ENVS.items() if env.of_paper)
RIVAL = "mle"


METRIC = "eval/return"
EXAMS = {
    "exam/footprint": "footprint",
    "exam/error": "error",
    "exam/rollout_error": "error after 5 steps",
}
"""the reported numbers of a learner's exams, by metric"""


@dataclass(frozen=True)
class Cell:
    """One learner in one environment: the runs and returns of all seeds."""

    env: str
    learner: str
    runs: tuple[RunReader, ...]
    curves: tuple[Curve, ...]
    preset: str = ""  # if it is not the first requested one

    @property
    def label(self) -> str:
        name = LEARNERS[self.learner].label
        return f"{name}, {self.preset}" if self.preset else name

    @property
    def method(self) -> tuple[str, str]:
        return self.learner, self.preset

    @property
    def n(self) -> int:
        return len(self.curves)

    @property
    def reach(self) -> float:
        """The last evaluated step that every seed reaches."""
        return common_step(self.curves)

    @property
    def longest(self) -> float:
        """The last evaluated step of any seed."""
        return max(float(curve.step[-1]) for curve in self.curves)

    @property
    def seeds(self) -> list[int]:
        return [curve.seed for curve in self.curves]

    def scores(self, step: float, score: str = BEST) -> Array:
        """The best return of each seed up to `step`, or another score of SCORES, (n,)."""
        return scores_of(self.curves, score, step)


def select(runs: Sequence[RunReader], *presets: str) -> tuple[list[Cell], list[str]]:
    """The cells of the runs of `presets`, and the ids of runs that were left out.

    All runs of a learner are left out if one was first evaluated after the step of the comparison.
    """
    mine = [
        run
        for run in runs
        if run.env in ENVS and run.learner in LEARNER_NAMES and run.preset in presets
    ]
    kind_of = kinds(mine)
    recorded = [(run, _curve(run, kind_of[run.run_id])) for run in mine]
    usable = sorted(((r, c) for r, c in recorded if len(c.step)), key=_key)
    cells, left_out = [], []
    for (env, learner, preset), group in groupby(usable, _key):
        every = list(group)
        chosen = _largest(every)
        shown = "" if preset == presets[0] else preset
        cells.append(Cell(env, learner, *zip(*chosen, strict=True), preset=shown))
        used = {run.run_id for run, _ in chosen}
        left_out += [run.run_id for run, _ in every if run.run_id not in used]
    at = compared_at(cells)
    late = [cell for cell in cells if not begun(cell.curves, at[cell.env])]
    left_out += [run.run_id for cell in late for run in cell.runs]
    order = {name: i for i, name in enumerate((*ENVS, *LEARNER_NAMES))}
    kept = [cell for cell in cells if cell not in late]
    return sorted(kept, key=lambda c: (order[c.env], order[c.learner], c.preset)), left_out


def compared_at(cells: Sequence[Cell]) -> dict[str, float]:
    """For each environment the last step that all its runs reach."""
    return {
        env: common_step(curve for c in cells if c.env == env for curve in c.curves)
        for env in _envs(cells)
    }


def summary(cells: Sequence[Cell]) -> list[dict[str, Any]]:
    """One row per environment and learner; scores are best returns up to the common step."""
    at, rows = compared_at(cells), []
    for cell in cells:
        step = at[cell.env]
        scores = cell.scores(step)
        mean, iqm = interval(scores), interval(scores, "iqm")
        area = interval(cell.scores(step, HEIGHT))
        rival = _cell(cells, cell.env, RIVAL)
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


def improvement(cells: Sequence[Cell]) -> list[dict[str, Any]]:
    """How often a run of TOM beats a run of each other learner, over the tasks that both have.

    For every preset of TOM, by the best return and by the area under the curve (its mean height).
    """
    methods = sorted({cell.method: cell.label for cell in cells}.items())
    rows = []
    for (learner, preset), label in methods:
        if learner != "tom":
            continue
        rivals = [(name, of) for name, of in methods if name != (learner, preset)]
        for rival, of in rivals:
            pairs = _pairs(cells, (learner, preset), rival)
            rows += [_wins(label, of, pairs, compared_at(cells), by) for by in (BEST, HEIGHT)] * (
                len(pairs) > 0
            )
    return rows


def _pairs(
    cells: Sequence[Cell], ours: tuple[str, str], theirs: tuple[str, str]
) -> dict[str, tuple[Cell, Cell]]:
    """The scores of both by task, for tasks in which both have runs."""
    both = {env: (_cell(cells, env, *ours), _cell(cells, env, *theirs)) for env in _envs(cells)}
    return {env: (one, other) for env, (one, other) in both.items() if one and other}


def _wins(
    ours: str, theirs: str, pairs: Mapping[str, tuple[Cell, Cell]], at: Mapping[str, float], by: str
) -> dict[str, Any]:
    wins = beats(
        [one.scores(at[env], by) for env, (one, _) in pairs.items()],
        [other.scores(at[env], by) for env, (_, other) in pairs.items()],
    )
    return {
        "TOM": ours,
        "against": theirs,
        "by": "best return" if by == BEST else "area under the curve",
        "wins": wins.value,
        "low": wins.low,
        "high": wins.high,
        "tasks": " ".join(pairs),
        "remark": remark([min(one.n, other.n) for one, other in pairs.values()]),
    }


def exams(cells: Sequence[Cell]) -> list[dict[str, Any]]:
    """One row per environment and learner whose runs have exams: the median fit of each run.

    It has the mean over runs and its bootstrap interval (`tom.exams`).
    """
    rows = []
    for cell in cells:
        medians = [_exam_medians(run) for run in cell.runs]
        whole = [one for one in medians if one is not None]
        if not whole:
            continue
        row: dict[str, Any] = {"env": cell.env, "learner": cell.label, "n": len(whole)}
        for name, values in zip(EXAMS.values(), np.array(whole).T, strict=True):
            mean = interval(values)
            row |= {name: mean.value, f"{name} low": mean.low, f"{name} high": mean.high}
        rows.append(row | {"remark": remark(len(whole))})
    return rows


def _exam_medians(run: RunReader) -> list[float] | None:
    """For each of EXAMS the median over the run's fits; None for a run without exams."""
    metrics = run.metrics()
    if not set(EXAMS) <= set(metrics):
        return None
    return [float(np.nanmedian(metrics[name].to_numpy(np.float64))) for name in EXAMS]


def missing(cells: Sequence[Cell], envs: Sequence[str], learners: Sequence[str]) -> list[dict]:
    """The paper's seeds and steps that the store lacks, with the command that adds them."""
    rows = []
    for env in (env for env in envs if env in PAPER_ENVS):
        for learner in learners:
            cell, steps = _cell(cells, env, learner), task(env).steps
            full = [c for c in cell.curves if c.step[-1] >= steps] if cell else []
            if len(full) < PAPER_SEEDS:
                rows.append(
                    {
                        "env": env,
                        "learner": LEARNERS[learner].label,
                        "runs of full length": f"{len(full)} of {PAPER_SEEDS}",
                        "longest": int(cell.longest) if cell else 0,
                        "of": steps,
                        "command": f"tom sweep --env {env} --learner {learner} --seeds 4",
                    }
                )
    return rows


def verdict(cells: Sequence[Cell]) -> list[str]:
    """In how many of the paper's environments TOM's mean is the highest, and the reservations."""
    return [*_ranking(cells), *_unlike(cells)]


def _unlike(cells: Sequence[Cell]) -> list[str]:
    """One line per environment whose learners were trained with different settings."""
    lines = []
    for env in _envs(cells):
        paths = unlike([run for c in cells if c.env == env for run in c.runs])
        if paths:
            lines.append(
                f"{env}: the learners' runs differ in more than learner, seed and steps "
                f"({', '.join(paths)}), so returns may differ by these settings."
            )
    return lines


def _ranking(cells: Sequence[Cell]) -> list[str]:
    at = compared_at(cells)
    judged = {env: [c for c in cells if c.env == env] for env in at if env in PAPER_ENVS}
    judged = {e: cs for e, cs in judged.items() if len(cs) > 1 and _cell(cs, e, "tom")}
    if not judged:
        return ["No environment of the paper has TOM beside another learner: nothing to compare."]
    first = [env for env, group in judged.items() if _tom_is_first(group, at[env])]
    named = f" ({', '.join(first)})" if first else ""
    lines = [
        f"TOM has the highest mean in {len(first)} of {len(judged)} of the paper's environments"
        f"{named}; the paper says 4 of 5."
    ]
    few = min(c.n for cs in judged.values() for c in cs)
    if remark(few):
        lines.append(f"The smallest group: {remark(few)}.")
    short = [
        f"{env} {at[env]:.0f} of {task(env).steps}" for env in judged if at[env] < task(env).steps
    ]
    if short:
        lines.append(f"Compared before the end of the paper's training: {'; '.join(short)} steps.")
    return lines


def _tom_is_first(cells: Sequence[Cell], step: float) -> bool:
    means = {cell.method: float(cell.scores(step).mean()) for cell in cells}
    tom = means.pop(("tom", ""))
    return all(tom > mean for (learner, _), mean in means.items() if learner != "tom")


def _curve(run: RunReader, kind: Kind) -> Curve:
    step, value = curve_points(run.metrics(), METRIC)
    return Curve(run.run_id, run.env, *kind[:2], run.seed, step, value, kind.variant)


def _key(recorded: Recorded) -> tuple[str, str, str]:
    run, _ = recorded
    return run.env, run.learner, run.preset


def _largest(every: Sequence[Recorded]) -> list[Recorded]:
    """The runs with the settings that most seeds share; of equal groups the longer one."""
    groups: dict[str, dict[int, Recorded]] = {}
    for run, curve in sorted(every, key=lambda one: (one[1].step[-1], one[0].created)):
        groups.setdefault(curve.variant, {})[curve.seed] = run, curve
    chosen = max(groups.values(), key=lambda g: (len(g), max(c.step[-1] for _, c in g.values())))
    return [chosen[seed] for seed in sorted(chosen)]


def _envs(cells: Sequence[Cell]) -> list[str]:
    return list(dict.fromkeys(cell.env for cell in cells))


def _cell(cells: Sequence[Cell], env: str, learner: str, preset: str = "") -> Cell | None:
    return next((c for c in cells if (c.env, *c.method) == (env, learner, preset)), None)
