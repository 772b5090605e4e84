"""How groups of runs are told apart: what they are called, colour, dash and marker of each."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from app.figures.base import DASHES
from app.theme import (
    NEUTRAL,
    QUALITATIVE,
    SYMBOLS,
    Mode,
    learner_colour,
    learner_label,
    learner_symbol,
    ramp,
)
from tom.analysis.grouping import USUAL, Kind, natural, number


@dataclass(frozen=True)
class Look:
    """How a group is called and drawn, wherever it is."""

    title: str
    colour: str
    dash: str
    symbol: str


def looks(
    found: Iterable[tuple[str, Kind]], by: str = USUAL, mode: Mode = "light"
) -> dict[Kind, Look]:
    """The look of every kind that is found in a task: pairs (environment, kind).

    A learner has its own colour, its first group a solid line and each further one another dash.
    Values of a setting have colours of their own, in order where they are numbers; groups to which
    the setting means nothing are grey.
    """
    tasks = Counter(kind for _, kind in set(found))
    if by in (USUAL, "learner"):
        return _of_learners(tasks)
    values = sorted((kind for kind in tasks if not kind.learner), key=_order)
    return _of_values(values, by, mode) | _left_grey(tasks)


def _of_learners(tasks: Mapping[Kind, int]) -> dict[Kind, Look]:
    # What is there in most tasks comes first, and so is the solid line of its learner.
    found: dict[Kind, Look] = {}
    for kind in sorted(tasks, key=lambda kind: (kind.learner, -tasks[kind], kind)):
        place = sum(other.learner == kind.learner for other in found)
        colour, symbol = learner_colour(kind.learner), learner_symbol(kind.learner)
        found[kind] = Look(_title(kind, tasks), colour, DASHES[place % len(DASHES)], symbol)
    return found


def _of_values(values: Sequence[Kind], by: str, mode: Mode) -> dict[Kind, Look]:
    # Seeds are numbers that mean nothing.
    ordered = by != "seed" and all(number(kind, by) is not None for kind in values)
    colours = ramp(len(values), mode) if ordered else QUALITATIVE
    return {
        kind: Look(
            _title(kind, values),
            colours[i % len(colours)],
            DASHES[i // len(colours) % len(DASHES)],
            SYMBOLS[i % len(SYMBOLS)],
        )
        for i, kind in enumerate(values)
    }


def _left_grey(kinds: Iterable[Kind]) -> dict[Kind, Look]:
    left = sorted(kind for kind in kinds if kind.learner)
    return {
        kind: Look(
            _title(kind, left), NEUTRAL, DASHES[i % len(DASHES)], learner_symbol(kind.learner)
        )
        for i, kind in enumerate(left)
    }


def _title(kind: Kind, among: Iterable[Kind]) -> str:
    """`TOM`; the preset too where its learner has several, and the settings."""
    presets = {other.preset for other in among if other.learner == kind.learner}
    preset = kind.preset if len(presets) > 1 or not kind.learner else ""
    return ", ".join(filter(None, (learner_label(kind.learner), preset, kind.variant)))


def _order(kind: Kind) -> list[tuple[float, str]]:
    return natural(" ".join(kind))
