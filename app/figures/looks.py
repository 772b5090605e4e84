"""What distinguishes groups of runs in a figure: title, colour, dash and marker."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from hashlib import blake2b

from app.figures.base import DASHES
from app.theme import (
    NEUTRAL,
    QUALITATIVE,
    SYMBOLS,
    Mode,
    learner_colour,
    learner_label,
    learner_symbol,
    mixed,
    ramp,
)
from tom.analysis.grouping import USUAL, Kind, natural, number
from tom.learners import SUBJECT

MAIN_PRESET = {SUBJECT: "mended"}
"""of learners whose main preset is not the paper's"""


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

    A learner has its own hue, each of its groups a shade of it. Grouped by a setting, each value
    has its own colour, in order if the values are numbers; groups of learners without that setting
    are grey.
    """
    tasks = Counter(kind for _, kind in set(groups))
    if by in (USUAL, "learner"):
        return _of_learners(tasks)
    values = sorted((kind for kind in tasks if not kind.learner), key=_order)
    return _of_values(values, by, mode) | _left_grey(tasks)


def _of_learners(tasks: Mapping[Kind, int]) -> dict[Kind, Look]:
    return {
        kind: Look(_title(kind, tasks), _shade(kind), "solid", learner_symbol(kind.learner))
        for kind in sorted(tasks)
    }


def _shade(kind: Kind) -> str:
    """A group's colour: the hue of its learner, full for its main preset and else paler.

    It depends on nothing but the group itself, so that no filter changes it.
    """
    colour = learner_colour(kind.learner)
    if kind.preset not in (MAIN_PRESET.get(kind.learner, "paper"), "smoke"):
        colour = mixed(colour, "#ffffff", 0.45)
    if kind.variant:
        level = int(blake2b(kind.variant.encode(), digest_size=1).hexdigest(), 16) / 255
        colour = mixed(mixed(colour, NEUTRAL, 0.5), "#000000", 0.4 * level)
    return colour


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
    called = " ".join(filter(None, (learner_label(kind.learner), preset)))
    return ", ".join(filter(None, (called, kind.variant)))


def _order(kind: Kind) -> list[tuple[float, str]]:
    return natural(" ".join(kind))
