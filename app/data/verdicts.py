"""The answer of a study's tables to its question: a word by a stated rule, and what is against it.

The rule: a group differs if its 95 % interval leaves out the level of no difference; where there
are only tests, if p is below .05 after correction (Bonferroni's, or the table's own).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from app.data import studies
from app.data.studies import Study
from tom.learners import LEARNERS
from tom.readable import percent

BY_LABEL = {entry.label: name for name, entry in LEARNERS.items()}
WAYS = {
    "uniform": "MLE (uniform)", "newest": "newest seventh", "recency": "PMAC (recency)",
    "half-recency": "half PMAC, half uniform", "vagram": "VaGram", "ratio": "ratio",
    "half-ratio": "half ratio, half uniform", "pdml": "PDML",
    "half-pdml": "half PDML, half uniform", "policy-distance": "policy distance",
    "half-policy-distance": "half policy distance, half uniform", "pmer": "PMER",
    "half-pmer": "half PMER, half uniform", "action-ratio": "action ratio",
    "half-action-ratio": "half action ratio, half uniform", "tom-released": "TOM as released",
    "tom-discounted": "TOM as printed", "tom-mended": "TOM mended",
    "half-tom-mended": "half TOM mended, half uniform",
}  # fmt: skip
"""the ways of weighing of `tom reproduce`, for people; others are variants of the flow"""
PRINTED, MENDED = "tom-discounted", "tom-mended"
SIGNIFICANT = 0.05
Tables = Mapping[str, Sequence[Mapping[str, Any]]]
"""the rows of a study's tables by the files' names"""


@dataclass(frozen=True)
class Point:
    """A result with its 95 % interval (NaN without), in a line of its own or of several."""

    line: str
    series: str
    learner: str
    symbol: str  # Plotly's: full, open for TOM as printed, a diamond for half uniform weights
    value: float
    low: float
    high: float


@dataclass(frozen=True)
class Verdict:
    """The answer to a study's question, and the figure that shows it."""

    word: str
    sentence: str
    against: str
    axis: str
    level: float
    """the value on the axis that means no difference"""
    points: Sequence[Point]


def verdict(study: Study) -> Verdict | None:
    """The verdict on a study's question; None without a rule for it, or without its tables."""
    rule = RULES.get(study.verb)
    read = {path.stem: studies.table(path) for path in study.tables}
    tables = {name: table.to_dict("records") for name, table in read.items() if table is not None}
    try:
        return None if rule is None else rule(tables)
    except (KeyError, ValueError, StopIteration):  # tables of another version
        return None


def _footprint(tables: Tables) -> Verdict:
    rows = {row["way"]: row for row in tables["summary"]}
    ours = [rows[PRINTED], rows[MENDED]]
    distances = [
        f"{WAYS[row['way']]} to {percent(row['distance'], 0)} "
        f"({percent(row['low'], 0)} to {percent(row['high'], 0)})"
        for row in ours
    ]
    sentence = (
        f"Weights bring a buffer nearer to what the policy does next: {', '.join(distances)} of "
        f"the distance without weights ({ours[0]['n']:.0f} moments of recorded trainings)."
    )
    pair = next(
        row for row in tables["head-to-head"] if (row["way"], row["against"]) == (MENDED, "recency")
    )
    told = "differs from" if pair["p"] < SIGNIFICANT else "cannot be told from"
    against = (
        f"Recency, which trains nothing, brings it to {percent(rows['recency']['distance'], 0)}: "
        f"that {told} TOM mended (p {pair['p']:.2g}, {pair['recordings']:.0f} recordings)."
    )
    shown = sorted((rows[way] for way in WAYS if way in rows), key=lambda row: row["distance"])
    points = [
        _point(WAYS[row["way"]], "", row["way"], row["distance"], row["low"], row["high"])
        for row in shown
    ]
    axis = "distance to the policy (1: unweighted)"
    return Verdict(_word_of(ours), sentence, against, axis, 1, points)


def _capacity(tables: Tables) -> Verdict:
    table = [
        row for row in tables["head-to-head"] if row["against"] == "uniform" and row["way"] in WAYS
    ]
    ours = [row for row in table if row["way"] in (PRINTED, MENDED)]
    models = list(dict.fromkeys(row["model"] for row in ours))
    less = [m for m in models if all(row["high"] < 1 for row in ours if row["model"] == m)]
    cost = [
        f"{row['ratio']:.2f} ({row['low']:.2f} to {row['high']:.2f}) times with {WAYS[row['way']]}"
        for row in ours
        if row["model"] == models[-1]
    ]
    sentence = (
        f"TOM's weights lower the model's error where the policy goes for {' and '.join(less)} "
        f"(units x layers). The error of {models[-1]}, the paper's, is {' and '.join(cost)} what "
        "it is with uniform weights."
    )
    least = min(1.0, min(row["p"] for row in table) * len(table))
    against = f"Corrected for all {len(table)} tests of the table, the least p is {least:.2g}."
    points = [
        _point(row["model"], WAYS[row["way"]], row["way"], row["ratio"], row["low"], row["high"])
        for row in table
    ]
    axis = "model error (1: as with uniform weights)"
    return Verdict(_word_of(ours), sentence, against, axis, 1, points)


def _improvement(tables: Tables) -> Verdict:
    difference = "difference, "
    table = [row for row in tables["summary"] if row["what"].startswith(difference)]
    places = [row["what"].removeprefix(difference) for row in table]
    told = [row for row in table if row["p"] * len(table) < SIGNIFICANT]
    better = sum(2 * row["better in trials"] > row["n"] for row in told)
    trials = [
        f"{place} in {row['better in trials']:.0f} of {row['n']:.0f}"
        for place, row in zip(places, table, strict=True)
    ]
    sentence = (
        "After one fit, the policy returned more than with uniform weights, of equal trials: "
        f"{', '.join(trials)} (least p {min(row['p'] for row in table):.2g})."
    )
    against = (
        f"At most {max(row['recordings'] for row in table):.0f} recordings count in a test: only "
        "a large effect of weights could have been seen."
    )
    points = [
        _point(place, "", row["way"], row["better in trials"] / row["n"], np.nan, np.nan)
        for place, row in zip(places, table, strict=True)
    ]
    word = _word(better, len(told) - better, len(table))
    return Verdict(word, sentence, against, "share of trials that return more", 0.5, points)


def _returns(tables: Tables) -> Verdict:
    table = [
        row
        for row in tables["improvement"]
        if row["against"] == "MLE" and row["learner"].removesuffix(", mended") in BY_LABEL
    ]
    ours = [row for row in table if row["learner"].split(",")[0] == "TOM"]
    told = [row for row in ours if row["p of all"] < SIGNIFICANT]
    more = sum(row["wins"] > 0.5 for row in told)
    chances = [
        f"{_plain(row['learner'])} {10 * row['wins']:.0f} times in 10 (p {row['p']:.2g})"
        for row in ours
        if row["by"] == "best return"
    ]
    sentence = f"By best return, a random run beats one of MLE: {', '.join(chances)}."
    least = min(row["p of all"] for row in ours)
    remarks = dict.fromkeys(str(row["remark"]) for row in ours if isinstance(row["remark"], str))
    few = "".join(f" {one[0].upper()}{one[1:]}." for one in list(remarks)[:1])
    against = f"Corrected for all comparisons of the table, the least p is {least:.2g}.{few}"
    points = [
        Point(
            row["by"], _plain(row["learner"]), BY_LABEL[row["learner"].removesuffix(", mended")],
            "circle-open" if row["learner"] == "TOM" else "circle",
            row["wins"], row["low"], row["high"],
        )
        for row in table
    ]  # fmt: skip
    word = _word(more, len(told) - more, len(ours))
    return Verdict(word, sentence, against, "a random run beats one of MLE", 0.5, points)


RULES: dict[str, Callable[[Tables], Verdict]] = {
    "footprint": _footprint,
    "capacity": _capacity,
    "improvement": _improvement,
    "returns": _returns,
}


def _word_of(rows: Sequence[Mapping[str, Any]]) -> str:
    """The word for rows with an interval each of a quantity that is better below 1."""
    below, above = (row["high"] < 1 for row in rows), (row["low"] > 1 for row in rows)
    return _word(sum(below), sum(above), len(rows))


def _word(better: int, worse: int, count: int) -> str:
    """Of `count` comparisons, so many are better or worse beyond doubt."""
    if not better + worse:
        return "No difference seen"
    if better == count:
        return "Yes"
    return "In part" if better else "No"


def _point(line: str, series: str, way: str, value: float, low: float, high: float) -> Point:
    base = way.removeprefix("half-")
    called = {"uniform": "mle", "recency": "pmac", "newest": ""}
    learner = base if base in LEARNERS else called.get(base, base.partition("-")[0])
    symbol = "diamond-wide" if base != way else "circle-open" if way == PRINTED else "circle"
    return Point(line, series, learner, symbol, value, low, high)


def _plain(learner: str) -> str:
    """`TOM, mended` as pages call it."""
    return "TOM as printed" if learner == "TOM" else learner.replace(", mended", " mended")
