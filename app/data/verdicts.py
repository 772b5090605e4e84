"""The answer of a study's tables to its question: a word by a stated rule, and what is against it.

The rule: a group differs if its 95 % interval leaves out the level of no difference; without an
interval, as where a task has one recording, if p is below .05 after correction (Bonferroni's, or
the table's own). A study that has an acceptance is judged by how many of its numbers are met.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import isfinite, nan
from statistics import median
from typing import Any

from app.data import studies
from app.data.studies import Study
from tom.learners import LEARNERS
from tom.readable import percent
from tom.studies.frozen import MENDED, PRINTED, WAYS
from tom.studies.moments import sign_test, telling

BY_LABEL = {entry.label: name for name, entry in LEARNERS.items()}
LABELS = {name: way.label for name, way in WAYS.items() if way.label}
SIGNIFICANT = 0.05
NAMED = 3
"""numbers of an acceptance that are named"""
Tables = Mapping[str, Sequence[dict[str, Any]]]
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
    """what speaks against it; empty without anything"""
    axis: str
    level: float
    """the value on the axis that means no difference"""
    points: Sequence[Point]
    """none if the study's own picture shows it"""


def verdict(study: Study) -> Verdict | None:
    """The verdict on a study's question; None without a rule for it, or without its tables."""
    rule = RULES.get(study.verb)
    read = {path.stem: studies.table(path) for path in study.tables}
    tables = {
        name: [dict(row) for row in table.to_dict("records")]
        for name, table in read.items()
        if table is not None
    }
    try:
        return None if rule is None else rule(tables)
    except (LookupError, ValueError, StopIteration):  # tables of another version
        return None


def _footprint(tables: Tables) -> Verdict:
    rows = {row["way"]: row for row in tables["summary"]}
    ours = []
    for row in (rows[way] for way in (PRINTED, MENDED) if way in rows):
        signs = sign_test(
            (one["env"], one["recording"], 1 - one["footprint"])
            for one in telling(tables["moments"])
            if one["way"] == row["way"]
        )
        ours.append({**row, "p": signs.p, "better on": signs.above, "recordings": signs.n})
    word = _judged(ours)
    distances = [
        f"{LABELS[row['way']]} {percent(row['distance'], 0)} "
        f"({_sure(row, lambda end: percent(end, 0))})"
        for row in ours
    ]
    sentence = (
        "With weights a buffer keeps so much of its distance to what the policy does next: "
        f"{', '.join(distances)}. Recorded trainings at {ours[0]['n']:.0f} moments."
    )
    rivals = {"recency": "Recency", "policy-distance": "The policies' distance"}
    said = []
    for pair in tables["head-to-head"]:
        both = {pair["way"], pair["against"]}
        for rival, called in rivals.items():
            if both == {MENDED, rival}:
                told = "differs from" if pair["p"] < SIGNIFICANT else "cannot be told from"
                said.append(
                    f"{called}, which trains nothing, brings it to "
                    f"{percent(rows[rival]['distance'], 0)}: that {told} TOM mended (p "
                    f"{pair['p']:.2g}, {pair['recordings']:.0f} recordings)."
                )
    shown = sorted((rows[way] for way in LABELS if way in rows), key=lambda row: row["distance"])
    points = [
        _point(LABELS[row["way"]], "", row["way"], row["distance"], row["low"], row["high"])
        for row in shown
    ]
    axis = "distance to the policy (1: unweighted)"
    return Verdict(word, sentence, " ".join(said), axis, 1, points)


def _capacity(tables: Tables) -> Verdict:
    table = [
        row
        for row in tables["head-to-head"]
        if row["against"] == "uniform" and row["way"] in LABELS
    ]
    of_tom = [row for row in table if row["way"] in (PRINTED, MENDED)]
    ours, whose = (of_tom, "TOM's") if of_tom else (table, "These")
    models = list(dict.fromkeys(row["model"] for row in ours))
    less = [m for m in models if all(row["high"] < 1 for row in ours if row["model"] == m)]
    cost = [
        f"{row['ratio']:.2f} ({_sure(row, '{:.2f}'.format)}) times with {LABELS[row['way']]}"
        for row in table
        if row["model"] == models[-1] and not WAYS[row["way"]].half
    ]
    sentence = (
        f"{whose} weights lower the model's error where the policy goes for "
        f"{' and '.join(less) or 'no model'} (units x layers). The error of {models[-1]} is "
        f"{' and '.join(cost)} what it is with uniform weights."
    )
    least = min(1.0, min(row["p"] for row in table) * len(table))
    against = f"Corrected for all {len(table)} tests of the table, the least p is {least:.2g}."
    points = [
        _point(row["model"], LABELS[row["way"]], row["way"], row["ratio"], row["low"], row["high"])
        for row in table
    ]
    axis = "model error (1: as with uniform weights)"
    return Verdict(_judged(ours), sentence, against, axis, 1, points)


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
        _point(place, "", row["way"], row["better in trials"] / row["n"], nan, nan)
        for place, row in zip(places, table, strict=True)
    ]
    word = word_of(better, len(told) - better, len(table))
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
    word = word_of(more, len(told) - more, len(ours))
    return Verdict(word, sentence, against, "a random run beats one of MLE", 0.5, points)


def _focus(tables: Tables) -> Verdict:
    called = {"pmac": "PMAC", "tom paper": LABELS[PRINTED], "tom mended": LABELS[MENDED],
              "tom exact": "TOM exact"}  # fmt: skip
    rows = [row for row in tables["summary"] if row["rival"] in called]
    ours = [row for row in rows if row["rival"].startswith("tom")]
    gaps: dict[str, list[tuple[str, str, float]]] = {}
    for row in ours:
        less = 1 - row["policy / mle"]
        gaps.setdefault(called[row["rival"]], []).append(("", row["recording"], less))
    signs = {name: sign_test(of) for name, of in gaps.items()}
    told = [one for one in signs.values() if one.p * len(signs) < SIGNIFICANT]
    better = sum(2 * one.above > one.n for one in told)
    counts = [f"{name} on {one.above} of {one.n}" for name, one in signs.items()]
    sentence = (
        "On new steps of the policy the model errs less than MLE's, of all recordings: "
        f"{', '.join(counts)} (least p {min(one.p for one in signs.values()):.2g})."
    )
    least = min(1.0, 2.0 ** (1 - max(one.n for one in signs.values())))
    price = median(row["random / mle"] for row in ours)
    against = (
        f"On the buffer's random half the error is {price:.2f} times MLE's (median). So few "
        f"recordings have no p below {least:.2g}."
    )
    points = [
        Point(row["recording"], called[row["rival"]], row["rival"].partition(" ")[0],
              "circle-open" if row["rival"] == "tom paper" else "circle",
              row["policy / mle"], nan, nan)
        for row in rows
    ]  # fmt: skip
    word = word_of(better, len(told) - better, len(signs))
    axis = "model error where the policy goes (1: as MLE's)"
    return Verdict(word, sentence, against, axis, 1, points)


def _accepted(tables: Tables) -> Verdict:
    """By the numbers of the acceptance, which has no figure of its own."""
    judged = [row for row in tables["checks"] if str(row["met"]) in ("True", "False")]
    if not judged:
        raise ValueError("nothing was judged")
    missed = [str(row["name"]) for row in judged if str(row["met"]) == "False"]
    met = len(judged) - len(missed)
    sentence = f"{met} of the {len(judged)} numbers are met that were fixed beforehand."
    more = f", and {len(missed) - NAMED} more" if len(missed) > NAMED else ""
    against = f"Not met: {'; '.join(missed[:NAMED])}{more}." if missed else ""
    return Verdict(word_of(met, len(missed), len(judged)), sentence, against, "", 0, ())


RULES: dict[str, Callable[[Tables], Verdict]] = {
    "road": _accepted,
    "progression": _accepted,
    "focus": _focus,
    "footprint": _footprint,
    "capacity": _capacity,
    "improvement": _improvement,
    "returns": _returns,
    "tabular": _accepted,
}
"""of every study but `online`, whose profiles are of one seed each: no test, no interval"""


def _judged(rows: Sequence[Mapping[str, Any]]) -> str:
    """The word for rows of a quantity that is better below 1. Raises ValueError without any."""
    if not rows:
        raise ValueError("nothing to judge")
    sides = []
    for row in rows:
        better, worse = row["high"] < 1, row["low"] > 1
        if not isfinite(row["low"]) and row["p"] * len(rows) < SIGNIFICANT:
            better = 2 * row["better on"] > row["recordings"]
            worse = not better
        sides.append((better, worse))
    better, worse = map(sum, zip(*sides, strict=True))
    return word_of(better, worse, len(rows))


def _sure(row: Mapping[str, Any], number: Callable[[float], str]) -> str:
    """How sure a row's number is: its interval, else its test."""
    if isfinite(row["low"]):
        return f"{number(row['low'])} to {number(row['high'])}"
    return f"p {row['p']:.2g}, {row['recordings']:.0f} recordings"


def word_of(better: int, worse: int, count: int) -> str:
    """Of `count` comparisons, so many are better or worse beyond doubt."""
    if not better + worse:
        return "No difference seen"
    if better == count:
        return "Yes"
    return "In part" if better else "No"


def _point(line: str, series: str, way: str, value: float, low: float, high: float) -> Point:
    return Point(line, series, WAYS[way].learner or "", symbol(way), value, low, high)


def symbol(way: str) -> str:
    """The marker of a way: half uniform weights and TOM as printed have their own."""
    if WAYS[way].half:
        return "diamond-wide"
    return "circle-open" if way == PRINTED else "circle" if WAYS[way].label else "x"


def _plain(learner: str) -> str:
    """`TOM, mended` as pages call it."""
    return "TOM as printed" if learner == "TOM" else learner.replace(", mended", " mended")
