"""The answer of a study's tables to its question: a word by a stated rule, and what is against it.

The rule: a group differs if its p is below .05 after correction (Bonferroni's, or the table's own),
since 95 % intervals of few seeds and recordings are too narrow. A study that has an acceptance is
judged by how many of its numbers are met, the profiles of single runs by what most of them show.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import ModuleType
from typing import NamedTuple

from tom.analysis.statistics import SIGNIFICANT, Interval
from tom.studies.study import Row

MAX_NAMED = 3
"""numbers of an acceptance that are named"""
Tables = Mapping[str, Sequence[Row]]
"""the rows of a study's files by the files' names, as they are read; without empty files"""


class Point(NamedTuple):
    """A result with its 95 % interval (NaN without), in a line of its own or of several."""

    line: str
    series: str
    value: float
    low: float
    high: float
    learner: str = ""
    way: str = ""
    """of weighing (`tom.studies.frozen.WAYS`), where it is one"""


class Panel(NamedTuple):
    """One task: its ways, uniform weights first, and the number of recordings and moments."""

    env: str
    ways: Sequence[tuple[str, Interval, Interval]]
    """each with its distance and its error, which are 1 for uniform weights; less is better"""
    recordings: int
    moments: int


@dataclass(frozen=True)
class Verdict:
    """The answer to a question, and what its figure shows: points, panels, or nothing."""

    word: str
    sentence: str
    against: str
    """what speaks against it; empty without anything"""
    axis: str = ""
    level: float = 1
    """the value on the axis that means no difference"""
    points: Sequence[Point] = ()
    panels: Sequence[Panel] = ()
    caption: str = ""
    """of panels: what is drawn, n, and what is left out"""
    question: str = ""
    """what these tables answer, if it is not the study's question"""


def verdict_of(study: ModuleType, tables: Tables) -> Verdict | None:
    """The verdict of a study; None if its tables have nothing to judge, or are of another version.

    The tables are those that `tom.reports.report.read_tables` gives.
    """
    try:
        return study.verdict(tables)
    except (LookupError, ValueError):
        return None


def by_acceptance(tables: Tables) -> Verdict:
    """The verdict by the numbers of an acceptance, which has no figure of its own."""
    judged = [row for row in tables["checks"] if str(row["met"]) in ("True", "False")]
    missed = [str(row["name"]) for row in judged if str(row["met"]) == "False"]
    met = len(judged) - len(missed)
    sentence = f"{met} of the {len(judged)} bounds that were fixed beforehand are met."
    more = f", and {len(missed) - MAX_NAMED} more" if len(missed) > MAX_NAMED else ""
    against = f"Not met: {'; '.join(missed[:MAX_NAMED])}{more}." if missed else ""
    return Verdict(word_of([1] * met + [-1] * len(missed)), sentence, against)


def side(p: float, better: bool) -> int:
    """The outcome of a test by its corrected p: 1 for better, -1 for worse, 0 for neither."""
    return (1 if better else -1) if p < SIGNIFICANT else 0


def word_of(sides: Sequence[int]) -> str:
    """The word for comparisons: 1 is better, -1 worse, 0 neither. Raises ValueError without any."""
    if not sides:
        raise ValueError("nothing to judge")
    if not any(sides):
        return "No difference seen"
    if min(sides) == 1:
        return "Yes"
    return "In part" if max(sides) == 1 else "No"
