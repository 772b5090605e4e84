"""What the runs of a group have in common: all but the seed, or one setting that the user chooses.

A page and a report group here, so that they cannot disagree.
"""

import math
import re
from collections.abc import Sequence
from typing import NamedTuple

from tom.analysis.settings import NONE, Made, variants
from tom.learners import others_groups

USUAL = "all but the seed"
"""runs of a group differ only in the seed and in settings that change no number"""
_NUMBER = re.compile(r"(\d+(?:\.\d+)?(?:e[+-]?\d+)?)")


class Kind(NamedTuple):
    """What the runs of a group have in common; a part is empty if they may differ in it."""

    learner: str = ""
    preset: str = ""
    variant: str = ""
    """settings and their values, in words"""


def choices(runs: Sequence[Made]) -> list[str]:
    """The ways to group `runs`: as usual, or by a setting in which some of them differ.

    The environment is not among them, because no figure has runs of two. A setting of only some
    learners is among them if the runs of these learners differ in it.
    """
    values_of: dict[str, set[str]] = {}
    for run in runs:
        others = others_groups(run.learner)
        for path, words in run.settings.items():
            if path.partition(".")[0] not in others and words != NONE:
                values_of.setdefault(path, set()).add(words)
    paths = {path for path, values in values_of.items() if len(values) > 1} - {"env"}
    first = [path for path in ("learner", "preset") if path in paths]
    return [USUAL, *first, *sorted(paths.difference(first))]


def kinds(runs: Sequence[Made], by: str = USUAL) -> dict[str, Kind]:
    """The kind of each run, by its id.

    If they are grouped by a setting, runs with the same value form a group, even if they differ
    in other settings. Runs without a value, or of a learner without that setting, stay in their
    usual groups.
    """
    if by == "learner":
        return {run.run_id: Kind(learner=run.learner) for run in runs}
    if by == "preset":
        return {run.run_id: Kind(preset=run.preset) for run in runs}
    apart = variants(runs)
    usual = {run.run_id: Kind(run.learner, run.preset, apart[run.run_id]) for run in runs}
    if by == USUAL:
        return usual
    return {
        run.run_id: Kind(variant=f"{by} {words}") if (words := _of(run, by)) else usual[run.run_id]
        for run in runs
    }


def number(kind: Kind, by: str) -> float | None:
    """The value of the setting by which a kind was grouped; None if it is not a number."""
    try:
        value = float(kind.variant.removeprefix(f"{by} "))
    except ValueError:
        return None
    return value if kind.variant.startswith(f"{by} ") and math.isfinite(value) else None


def natural(words: str) -> list[tuple[float, str]]:
    """A sort key in which 64 comes before 128."""
    parts = enumerate(_NUMBER.split(words))
    return [(float(part), "") if i % 2 else (-1.0, part) for i, part in parts]


def _of(run: Made, path: str) -> str:
    """The value of a setting in words; empty if the run has none or its learner ignores it."""
    words = run.settings.get(path, NONE)
    mine = path.partition(".")[0] not in others_groups(run.learner)
    return words if mine and words != NONE else ""
