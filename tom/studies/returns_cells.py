"""The runs of a store as cells: one learner in one environment, all seeds.

A run belongs to its environment, learner, preset and seed; a learner with another than the first
requested preset counts as a separate learner ("TOM, mended"). If runs differ in other settings, the
largest group of each learner is used, or every group counts as a separate learner, as the user
likes ("TOM, mended, model.uniform_share 1"); in a group the longest run of each seed. The learners
of an environment are compared at a step that all their runs reach, or at one that the user fixed
before he looked, without the runs that end earlier. Runs are grouped and scored as on Curves
(`tom/analysis/scores.py`).
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from tom.analysis.curves import Curve, curve_points
from tom.analysis.scores import BEST, all_have_started, common_start, common_step, scores_of
from tom.analysis.settings import changed, kinds_of
from tom.envs import ENVS, ROAD, task_rank
from tom.learners import LEARNERS, learner_rank
from tom.record import RunReader

Array = NDArray[np.float64]
PAPER_ENVS = tuple(name for name, env in ENVS.items() if env.of_paper)
METRIC = "eval/return"


@dataclass(frozen=True, eq=False)
class Recorded:
    """One run, with what was read from it once."""

    run: RunReader
    metrics: pd.DataFrame
    curve: Curve


@dataclass(frozen=True, eq=False)
class Cell:
    """One learner in one environment: the runs, metrics and returns of all seeds."""

    env: str
    learner: str
    variant: str
    """in what its runs differ from the learner's in the first requested preset, in words"""
    recorded: tuple[Recorded, ...]
    at: float = np.inf
    """the step at which the learners of its environment are compared: the last that all reach"""
    since: float = -np.inf
    """the first step from which on all their runs have returns"""

    @property
    def runs(self) -> list[RunReader]:
        return [one.run for one in self.recorded]

    @property
    def curves(self) -> list[Curve]:
        return [one.curve for one in self.recorded]

    @property
    def label(self) -> str:
        name = LEARNERS[self.learner].label
        return f"{name}, {self.variant}" if self.variant else name

    @property
    def n(self) -> int:
        return len(self.recorded)

    @property
    def longest(self) -> float:
        """The last evaluated step of any seed."""
        return max(float(curve.step[-1]) for curve in self.curves)

    @property
    def seeds(self) -> list[int]:
        return [curve.seed for curve in self.curves]

    def scores(self, score: str = BEST) -> Array:
        """The best return of each seed up to `at`, or another score of SCORES, (n,)."""
        return scores_of(self.curves, score, self.at, self.since)


def select(
    runs: Sequence[RunReader],
    *presets: str,
    at: Mapping[str, int] | None = None,
    apart: bool = False,
    groups: Collection[str] | None = None,
) -> tuple[list[Cell], list[str]]:
    """The cells of the runs of `presets`, and the ids of runs that were left out.

    If `apart`, runs that differ in settings from their preset have cells of their own. Of `groups`,
    labels of cells, there are these alone: the runs of others bound no comparison.
    Curves of an environment in `at` end at that env step, and its runs without an evaluation there
    or later are left out. All runs of a learner are left out if one was first evaluated after the
    step of the comparison.
    """
    cells, left_out = all_cells(runs, presets, at or {}, apart)
    cells = [cell for cell in cells if groups is None or cell.label in groups]
    late = [cell for cell in compared(cells) if not all_have_started(cell.curves, cell.at)]
    left_out += [run.run_id for cell in late for run in cell.runs]
    excluded = {(cell.env, cell.label) for cell in late}
    return compared([cell for cell in cells if (cell.env, cell.label) not in excluded]), left_out


def all_cells(
    runs: Sequence[RunReader], presets: Sequence[str], at: Mapping[str, int], apart: bool
) -> tuple[list[Cell], list[str]]:
    """All cells with a return up to their step of `at`, and the ids of other runs."""
    mine = [run for run in runs if run.env != ROAD and run.preset in presets]
    kind_of, left_out = kinds_of(mine), []
    found: dict[tuple[str, str, str], list[Recorded]] = {}
    for run in mine:
        metrics, kind = run.metrics(), kind_of[run.run_id]
        points = curve_points(metrics, METRIC)
        curve = Curve(run.run_id, run.env, *kind[:2], run.seed, *points, kind.variant)
        if run.env in at:  # without points if it does not reach that step
            step = at[run.env]
            curve = curve.until(step if len(curve.step) and curve.step[-1] >= step else -1)
        if not len(curve.step):
            left_out.append(run.run_id)
            continue
        words = [run.preset] if run.preset != presets[0] else []
        if apart:
            words += [f"{path} {value}" for path, value in sorted(changed(run).items())]
        key = run.env, run.learner, ", ".join(words)
        found.setdefault(key, []).append(Recorded(run, metrics, curve))
    cells = []
    for key in sorted(found, key=lambda key: (*task_rank(key[0]), learner_rank(key[1]), key[2])):
        chosen = _largest(found[key])
        cells.append(Cell(*key, tuple(chosen)))
        left_out += [one.run.run_id for one in found[key] if one not in chosen]
    return cells, left_out


def _largest(every: Sequence[Recorded]) -> list[Recorded]:
    """The runs with the settings that most seeds share; of equal groups the longer one."""
    groups: dict[str, dict[int, Recorded]] = {}
    for one in sorted(every, key=lambda one: (one.curve.step[-1], one.run.created)):
        groups.setdefault(one.curve.variant, {})[one.curve.seed] = one
    chosen = max(groups.values(), key=lambda g: (len(g), max(o.curve.step[-1] for o in g.values())))
    return [chosen[seed] for seed in sorted(chosen)]


def compared(cells: Sequence[Cell]) -> list[Cell]:
    """The cells with the steps between which those of an environment are compared."""
    by_env = {
        cell.env: [c for of in cells if of.env == cell.env for c in of.curves] for cell in cells
    }
    return [
        replace(cell, at=common_step(by_env[cell.env]), since=common_start(by_env[cell.env]))
        for cell in cells
    ]


def compared_at(cells: Sequence[Cell]) -> dict[str, float]:
    """For each environment the step at which its learners are compared."""
    return {cell.env: cell.at for cell in cells}


def cell_of(cells: Sequence[Cell], env: str, learner: str) -> Cell | None:
    """The learner's cell of the first preset, with its settings."""
    wanted = env, learner, ""
    return next((c for c in cells if (c.env, c.learner, c.variant) == wanted), None)
