"""What weights do in the model and in the starts: the 2 x 2, where all four cells have runs.

A learner's weights act in two places: the fit of the model (Algorithm 2, lines 15-18) and the start
states of its rollouts (line 22). A defensive share of 1 makes one of them uniform
(`model.uniform_share`, `rollout.uniform_share`); without any weights the learner is MLE. The effect
of a place is the mean over both levels of the other.
"""

from collections.abc import Collection, Sequence

import numpy as np

from tom.analysis.scores import beats, chance, contrast
from tom.analysis.settings import changed, matters, unlike
from tom.analysis.statistics import corrected, remark
from tom.studies.returns_cells import Array, Cell, compared_at, compared_from
from tom.studies.returns_tables import MEASURES, RIVAL
from tom.studies.study import Row

UNIFORM_MODEL, UNIFORM_STARTS = "model.uniform_share", "rollout.uniform_share"
"""the settings that make one place uniform, if they are 1"""
EFFECTS = {
    "weighted model": (1, 1, -1, -1),
    "weighted starts": (1, -1, 1, -1),
    "both beyond their sum": (1, -1, -1, 1),
}
"""what the cells add to an effect: those with weights in both places, in the model, in the starts,
in neither"""


def factors(cells: Sequence[Cell], measures: Collection[str] = MEASURES) -> list[Row]:
    """One row per environment, learner, effect and measure; none without all four cells.

    "p" is that of `chance` with the other place's levels kept apart, and "p of all" is corrected
    for the number of rows that have one; the interaction has none, nor has a cell of one run.
    """
    at, since, rows = compared_at(cells), compared_from(cells), []
    for four in _designs(cells):
        env, few = four[0].env, remark([cell.n for cell in four])
        for by in measures:
            scores = [cell.scores(at[env], by, since[env]) for cell in four]
            for name, signs in EFFECTS.items():
                row = {"env": env, "learner": four[0].label, "effect of": name, "by": MEASURES[by]}
                rows.append({**row, **_effect(scores, signs), "remark": few})
    tested = iter(corrected([row["p"] for row in rows if np.isfinite(row["p"])]))
    return [row | {"p of all": next(tested) if np.isfinite(row["p"]) else np.nan} for row in rows]


def _effect(scores: Sequence[Array], signs: Sequence[int]) -> Row:
    """An effect, and of a place how often a run with weights there beats one without."""
    of_place = sum(signs[1:3]) == 0
    effect = contrast(scores, [sign / 2 if of_place else sign for sign in signs])
    row: Row = {"wins": np.nan, "p": np.nan}
    row |= {"effect": effect.value, "low": effect.low, "high": effect.high}
    if of_place:
        # In pairs that are alike in the other place.
        up, down = (
            [of for of, sign in zip(scores, signs, strict=True) if sign == level]
            for level in (1, -1)
        )
        row["wins"] = beats(up, down).value
        if min(map(len, scores)) > 1:
            row["p"] = chance(up, down)
    return row


def _designs(cells: Sequence[Cell]) -> list[tuple[Cell, Cell, Cell, Cell]]:
    """The cells with weights in both places, in the model, in the starts, and in neither."""
    found = []
    for both in (cell for cell in cells if cell.learner != RIVAL and _weighs_in_both(cell)):
        model, starts = (_uniform(cells, both, place) for place in (UNIFORM_STARTS, UNIFORM_MODEL))
        neither = next((cell for cell in cells if _is_rival(cell, both)), None)
        if model and starts and neither:
            found.append((both, model, starts, neither))
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
