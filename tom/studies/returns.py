"""Returns of every learner in every environment, from whatever runs a store has.

A run counts for its environment, learner and seed. Of runs with other settings the largest group of
each learner is taken; within it the longest run of a seed. Learners of an environment are compared
at a step that all their runs reach; where their groups' settings differ, the verdict says so.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tom.analysis import statistics as st
from tom.envs import ENVS, task
from tom.learners import LEARNER_NAMES, LEARNERS
from tom.record import RunReader
from tom.studies.settings import unlike

Array = NDArray[np.float64]
PAPER_SEEDS = 4
PAPER_ENVS = tuple(name for name, env in ENVS.items() if env.of_paper)
RIVAL = "mle"


@dataclass(frozen=True)
class ReturnCurve:
    """One run: evaluations at `step` (T,), their return and its running maximum (T,)."""

    run: RunReader
    step: Array
    value: Array

    @property
    def best(self) -> Array:
        return st.running_maximum(self.value)

    def best_at(self, step: float) -> float:
        """The best return up to `step`."""
        return float(self.value[self.step <= step].max())


@dataclass(frozen=True)
class Cell:
    """All seeds of one learner in one environment, by seed."""

    env: str
    learner: str
    curves: tuple[ReturnCurve, ...]

    @property
    def n(self) -> int:
        return len(self.curves)

    @property
    def reach(self) -> float:
        """The last step that every seed was evaluated at or beyond."""
        return min(float(curve.step[-1]) for curve in self.curves)

    @property
    def seeds(self) -> list[int]:
        return [curve.run.seed for curve in self.curves]

    def scores(self, step: float) -> Array:
        """The best return of each seed up to `step`, (n,)."""
        return np.array([curve.best_at(step) for curve in self.curves])


def select(runs: Sequence[RunReader], preset: str) -> tuple[list[Cell], list[str]]:
    """The cells that the runs of `preset` fill, and the ids of runs that were left out."""
    usable = [
        curve
        for run in runs
        if run.env in ENVS and run.learner in LEARNER_NAMES and run.config.get("preset") == preset
        if (curve := _curve(run)) is not None
    ]
    cells, left_out = [], []
    for (env, learner), group in groupby(sorted(usable, key=_key), _key):
        curves = list(group)
        cell = Cell(env, learner, _largest(curves))
        cells.append(cell)
        used = {curve.run.run_id for curve in cell.curves}
        left_out += [c.run.run_id for c in curves if c.run.run_id not in used]
    order = {name: i for i, name in enumerate((*ENVS, *LEARNER_NAMES))}
    return sorted(cells, key=lambda c: (order[c.env], order[c.learner])), left_out


def compared_at(cells: Sequence[Cell]) -> dict[str, float]:
    """For each environment the step that all its runs reach."""
    return {env: min(c.reach for c in cells if c.env == env) for env in _envs(cells)}


def summary(cells: Sequence[Cell], rng: np.random.Generator) -> list[dict[str, Any]]:
    """A row for each environment and learner; scores are best returns up to the common step."""
    at, rows = compared_at(cells), []
    for cell in cells:
        step = at[cell.env]
        found = st.summary(cell.scores(step)[:, None], rng)
        level = next((c for c in cells if (c.env, c.learner) == (cell.env, RIVAL)), None)
        target = float(level.scores(step).mean()) if level else np.nan
        reached = [st.steps_to_reach(c.step, c.value, target) for c in cell.curves]
        areas = [st.area_under_curve(c.step, c.value, step) for c in cell.curves]
        rows.append(
            {
                "env": cell.env,
                "learner": LEARNERS[cell.learner].label,
                "n": cell.n,
                "seeds": " ".join(map(str, cell.seeds)),
                "at step": int(step),
                "mean": found.mean.value,
                "low": found.mean.low,
                "high": found.mean.high,
                "median": found.median.value,
                "IQM": found.iqm.value,
                "area": float(np.mean(areas)),
                "steps to MLE's": float(np.median(reached)) if level else np.nan,
                "reach": int(cell.reach),
                "paper's steps": task(cell.env).steps,
                "remark": found.remark,
            }
        )
    return rows


def improvement(cells: Sequence[Cell], rng: np.random.Generator) -> list[dict[str, Any]]:
    """How often a run of TOM beats a run of each other learner, over the tasks both have."""
    rows = []
    for rival in LEARNER_NAMES:
        at = compared_at(cells)
        pairs = {
            env: (ours, theirs)
            for env in at
            if (ours := _cell(cells, env, "tom")) and (theirs := _cell(cells, env, rival))
        }
        if rival == "tom" or not pairs:
            continue
        ours = _matrix([pair[0].scores(at[env]) for env, pair in pairs.items()])
        theirs = _matrix([pair[1].scores(at[env]) for env, pair in pairs.items()])
        found = st.probability_of_improvement(ours, theirs, rng)
        counts = [min(pair[0].n, pair[1].n) for pair in pairs.values()]
        rows.append(
            {
                "TOM against": LEARNERS[rival].label,
                "wins": found.value,
                "low": found.low,
                "high": found.high,
                "tasks": " ".join(pairs),
                "remark": st.remark(counts),
            }
        )
    return rows


def missing(cells: Sequence[Cell], envs: Sequence[str], learners: Sequence[str]) -> list[dict]:
    """What the paper has and the store has not: seeds and steps, with the command that adds it."""
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
                        "longest": int(max(c.step[-1] for c in cell.curves)) if cell else 0,
                        "of": steps,
                        "command": f"tom sweep --env {env} --learner {learner} --seeds 4",
                    }
                )
    return rows


def verdict(cells: Sequence[Cell]) -> list[str]:
    """In how many of the paper's environments TOM's mean is the highest; what speaks against it."""
    return [*_ranking(cells), *_unlike(cells)]


def _unlike(cells: Sequence[Cell]) -> list[str]:
    """A line for each environment whose learners were not trained with the same settings."""
    lines = []
    for env in _envs(cells):
        found = unlike([curve.run for c in cells if c.env == env for curve in c.curves])
        if found:
            lines.append(
                f"{env}: the learners' runs differ in more than learner, seed and steps "
                f"({', '.join(found)}), so returns may differ by these settings."
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
    if st.remark(few):
        lines.append(f"The smallest group: {st.remark(few)}.")
    short = [
        f"{env} {at[env]:.0f} of {task(env).steps}" for env in judged if at[env] < task(env).steps
    ]
    if short:
        lines.append(f"Compared before the end of the paper's training: {'; '.join(short)} steps.")
    return lines


def _tom_is_first(cells: Sequence[Cell], step: float) -> bool:
    means = {cell.learner: float(cell.scores(step).mean()) for cell in cells}
    return all(means["tom"] > mean for learner, mean in means.items() if learner != "tom")


def _curve(run: RunReader) -> ReturnCurve | None:
    table = run.metrics()
    if "eval/return" not in table:
        return None
    known = table[["env_step", "eval/return"]].dropna().to_numpy(np.float64)
    return ReturnCurve(run, known[:, 0], known[:, 1]) if len(known) else None


def _key(curve: ReturnCurve) -> tuple[str, str]:
    return curve.run.env, curve.run.learner


def _largest(curves: Sequence[ReturnCurve]) -> tuple[ReturnCurve, ...]:
    """The seeds of the settings that most seeds share; the longer ones where it is a draw."""
    groups: dict[str, dict[int, ReturnCurve]] = {}
    for curve in sorted(curves, key=lambda c: (c.step[-1], c.run.created)):
        settings = {**curve.run.config["config"], "seed": None, "steps": None}
        groups.setdefault(repr(sorted(settings.items())), {})[curve.run.seed] = curve
    chosen = max(groups.values(), key=lambda g: (len(g), max(c.step[-1] for c in g.values())))
    return tuple(chosen[seed] for seed in sorted(chosen))


def _envs(cells: Sequence[Cell]) -> list[str]:
    return list(dict.fromkeys(cell.env for cell in cells))


def _cell(cells: Sequence[Cell], env: str, learner: str) -> Cell | None:
    return next((c for c in cells if (c.env, c.learner) == (env, learner)), None)


def _matrix(columns: Sequence[Array]) -> Array:
    """(runs, tasks), NaN below where a task has fewer runs."""
    matrix = np.full((max(map(len, columns)), len(columns)), np.nan)
    for i, column in enumerate(columns):
        matrix[: len(column), i] = column
    return matrix
