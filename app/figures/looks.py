"""What distinguishes groups of runs in a figure: title, colour, dash and marker."""

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
from tom.analysis.settings import USUAL, Kind, natural, number


@dataclass(frozen=True)
class Look:
    """The title and style of a group, the same in every figure."""

    title: str
    colour: str
    dash: str
    symbol: str


def looks(
    groups: Iterable[tuple[str, Kind]], by: str = USUAL, mode: Mode = "light"
) -> dict[Kind, Look]:
    """The look of every kind among the groups, which are pairs (environment, kind).

    A learner has its own colour; its first group has a solid line and each further one another
    dash. Grouped by a setting, each value has its own colour, in order if the values are numbers;
    groups of learners without that setting are grey.
    """
    tasks = Counter(kind for _, kind in set(groups))
    if by in (USUAL, "learner"):
        return _of_learners(tasks)
    values = sorted((kind for kind in tasks if not kind.learner), key=_order)
    return _of_values(values, by, mode) | _left_grey(tasks)


def _of_learners(tasks: Mapping[Kind, int]) -> dict[Kind, Look]:
    # The kind with the most tasks comes first, so its learner's solid line belongs to it.
    look_of: dict[Kind, Look] = {}
    for kind in sorted(tasks, key=lambda kind: (kind.learner, -tasks[kind], kind)):
        place = sum(other.learner == kind.learner for other in look_of)
        colour, symbol = learner_colour(kind.learner), learner_symbol(kind.learner)
        look_of[kind] = Look(_title(kind, tasks), colour, DASHES[place % len(DASHES)], symbol)
    return look_of


def _of_values(values: Sequence[Kind], by: str, mode: Mode) -> dict[Kind, Look]:
    # Seeds are numbers without a meaning.
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
    """The learner, such as `TOM`, then the preset if its learner has several, and the settings."""
    presets = {other.preset for other in among if other.learner == kind.learner}
    preset = kind.preset if len(presets) > 1 or not kind.learner else ""
    return ", ".join(filter(None, (learner_label(kind.learner), preset, kind.variant)))


def _order(kind: Kind) -> list[tuple[float, str]]:
    return natural(" ".join(kind))
