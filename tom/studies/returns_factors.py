"""What weights do in the model and in the starts: the 2 x 2, where all four cells have runs.

A learner's weights act in two places: the fit of the model (Algorithm 2, lines 15-18) and the start
states of its rollouts (line 22). A defensive share of 1 makes one of them uniform
(`model.uniform_share`, `rollout.uniform_share`); without any weights the learner is MLE. The effect
of a place is the mean over both levels of the other.
"""

from collections.abc import Collection, Sequence
from typing import Any, NamedTuple

import numpy as np

from tom.analysis.scores import beats, chance, contrast
from tom.analysis.settings import changed, matters, unlike
from tom.analysis.statistics import corrected, remark
from tom.studies.returns import Array, Cell, compared_at, compared_from
from tom.studies.returns_tables import MEASURES, RIVAL

UNIFORM_MODEL, UNIFORM_STARTS = "model.uniform_share", "rollout.uniform_share"
"""the settings that make one place uniform, if they are 1"""


class Design(NamedTuple):
    """The four cells, named by what is weighted."""

    both: Cell
    model: Cell
    starts: Cell
    neither: Cell


PLACES = {"weighted model": (1, 1, -1, -1), "weighted starts": (1, -1, 1, -1)}
"""which cells have weights in a place, in the order of Design"""
INTERACTION = "both beyond their sum", (1, -1, -1, 1)


def factors(cells: Sequence[Cell], measures: Collection[str] = MEASURES) -> list[dict[str, Any]]:
    """One row per environment, learner, effect and measure; none without all four cells.

    "p" is that of `chance` with the other place's levels kept apart, and "p of all" is corrected
    for the number of rows that have one; the interaction has none, nor has a cell of one run.
    """
    at, since, rows = compared_at(cells), compared_from(cells), []
    for design in _designs(cells):
        env, base = design.both.env, design.both.label
        for by in measures:
            scores = [cell.scores(at[env], by, since[env]) for cell in design]
            effects = {name: _of_place(scores, signs) for name, signs in PLACES.items()}
            effects[INTERACTION[0]] = _contrast(scores, INTERACTION[1])
            few = remark([cell.n for cell in design])
            rows += [
                {"env": env, "learner": base, "effect of": name, "by": MEASURES[by]}
                | {"wins": np.nan, "p": np.nan, **effect}
                | {"remark": few}
                for name, effect in effects.items()
            ]
    tested = iter(corrected([row["p"] for row in rows if np.isfinite(row["p"])]))
    return [row | {"p of all": next(tested) if np.isfinite(row["p"]) else np.nan} for row in rows]


def _designs(cells: Sequence[Cell]) -> list[Design]:
    found = []
    for both in (cell for cell in cells if cell.learner != RIVAL and _weighs_in_both(cell)):
        model, starts = (_uniform(cells, both, place) for place in (UNIFORM_STARTS, UNIFORM_MODEL))
        neither = next((cell for cell in cells if _is_rival(cell, both)), None)
        if model and starts and neither:
            found.append(Design(both, model, starts, neither))
    return found


def _weighs_in_both(cell: Cell) -> bool:
    settings = changed(cell.runs[0])
    return all(settings.get(place) != "1.0" for place in (UNIFORM_MODEL, UNIFORM_STARTS))


def _uniform(cells: Sequence[Cell], both: Cell, place: str) -> Cell | None:
    """The cell that differs from `both` in uniform weights in this place alone."""
    wanted = {**changed(both.runs[0]), place: "1.0"}
    alike = (
        cell
        for cell in cells
        if (cell.env, cell.learner) == (both.env, both.learner)
        and cell.runs[0].preset == both.runs[0].preset
    )
    return next((cell for cell in alike if changed(cell.runs[0]) == wanted), None)


def _is_rival(cell: Cell, both: Cell) -> bool:
    """Whether it is MLE in the same task, with the same settings but for the learner's own."""
    if (cell.env, cell.learner) != (both.env, RIVAL):
        return False
    return not any(matters(path, RIVAL) for path in unlike([cell.runs[0], both.runs[0]]))


def _of_place(scores: Sequence[Array], signs: Sequence[int]) -> dict[str, float]:
    """The effect of weights in a place, and how often a run with them beats one without."""
    # In pairs that are alike in the other place.
    up = [run for run, sign in zip(scores, signs, strict=True) if sign > 0]
    down = [run for run, sign in zip(scores, signs, strict=True) if sign < 0]
    told = _contrast(scores, [sign / 2 for sign in signs]) | {"wins": beats(up, down).value}
    return told if min(map(len, scores)) < 2 else told | {"p": chance(up, down)}


def _contrast(scores: Sequence[Array], signs: Sequence[float]) -> dict[str, float]:
    effect = contrast(scores, signs)
    return {"effect": effect.value, "low": effect.low, "high": effect.high}
