"""What weights do in the model and in the starts: the 2 x 2, where all four cells have runs.

A learner's weights act in two places: the fit of the model (Algorithm 2, lines 15-18) and the start
states of its rollouts (line 22). A defensive share of 1 makes one of them uniform
(`model.uniform_share`, `rollout.uniform_share`); without any weights the learner is MLE. The effect
of a place is the mean over both levels of the other.
"""

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from tom.analysis.scores import beats, chance, contrast
from tom.analysis.statistics import corrected, remark
from tom.studies.returns import Array, Cell, cell_of, compared_at, compared_from
from tom.studies.returns_tables import MEASURES, RIVAL

UNIFORM_MODEL, UNIFORM_STARTS = "model.uniform_share 1.0", "rollout.uniform_share 1.0"
"""the variants of a learner with one place uniform, in words (`Cell.variant`)"""


class Design(NamedTuple):
    """The four cells, named by what is weighted."""

    both: Cell
    model: Cell
    starts: Cell
    neither: Cell


EFFECTS = {
    "weighted model": (0.5, 0.5, -0.5, -0.5),
    "weighted starts": (0.5, -0.5, 0.5, -0.5),
    "both beyond their sum": (1, -1, -1, 1),
}
"""contrasts of the cells' means, in the order of Design"""


def factors(cells: Sequence[Cell]) -> list[dict[str, Any]]:
    """One row per environment, learner, effect and measure; none without all four cells.

    "p" is that of `chance` with the other place's levels kept apart, and "p of all" is corrected
    for the number of rows that have one; the interaction has none.
    """
    at, since, rows = compared_at(cells), compared_from(cells), []
    for design in _designs(cells):
        env, base = design.both.env, design.both.label
        for by, words in MEASURES.items():
            scores = [cell.scores(at[env], by, since[env]) for cell in design]
            few = remark([cell.n for cell in design])
            rows += [
                {"env": env, "learner": base, "effect of": effect, "by": words}
                | _effect(scores, signs)
                | {"remark": few}
                for effect, signs in EFFECTS.items()
            ]
    tested = iter(corrected([row["p"] for row in rows if np.isfinite(row["p"])]))
    return [row | {"p of all": next(tested) if np.isfinite(row["p"]) else np.nan} for row in rows]


def _designs(cells: Sequence[Cell]) -> list[Design]:
    found = []
    for both in (cell for cell in cells if cell.learner != RIVAL):
        model, starts = (
            cell_of(cells, both.env, both.learner, _with(both.variant, uniform))
            for uniform in (UNIFORM_STARTS, UNIFORM_MODEL)
        )
        neither = cell_of(cells, both.env, RIVAL)
        if model and starts and neither:
            found.append(Design(both, model, starts, neither))
    return found


def _with(variant: str, change: str) -> str:
    return f"{variant}, {change}" if variant else change


def _effect(scores: Sequence[Array], signs: Sequence[float]) -> dict[str, float]:
    """The effect, and for a place how often a run with weights there beats one without."""
    effect = contrast(scores, signs)
    told = {"effect": effect.value, "low": effect.low, "high": effect.high}
    if abs(signs[0]) == 1:
        return told | {"wins": np.nan, "p": np.nan}
    # Runs with and without weights in this place, in pairs that are alike in the other.
    up = [run for run, sign in zip(scores, signs, strict=True) if sign > 0]
    down = [run for run, sign in zip(scores, signs, strict=True) if sign < 0]
    return told | {"wins": beats(up, down).value, "p": chance(up, down)}
