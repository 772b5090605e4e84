"""The answer of a study's tables to its question: a word by a stated rule, and what is against it.

The rule: a group differs if its 95 % interval leaves out the level of no difference; without an
interval, as where a task has one recording, if p is below .05 after correction (Bonferroni's, or
the table's own). A study that has an acceptance is judged by how many of its numbers are met,
the profiles of single runs by what most of them show.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from math import isfinite, nan
from statistics import median
from typing import NamedTuple

from app.data import run_names, studies
from app.data.studies import FACTORS, Study
from app.theme import learner_colour
from tom.analysis.scores import HEIGHT
from tom.analysis.statistics import Interval
from tom.learners import LEARNERS, SUBJECT
from tom.readable import percent
from tom.studies.frozen import MENDED, PRINTED, UNIFORM, WAYS
from tom.studies.moments import informative_outcomes, sign_test
from tom.studies.returns_tables import MEASURES
from tom.studies.study import Row

BY_LABEL = {entry.label: name for name, entry in LEARNERS.items()}
LABELS = {name: way.label for name, way in WAYS.items() if way.label}
SIGNIFICANT = 0.05
MAX_NAMED = 3
"""numbers of an acceptance that are named"""
Tables = Mapping[str, Sequence[Row]]
"""the rows of a study's tables by the files' names"""


class Point(NamedTuple):
    """A result with its 95 % interval (NaN without), in a line of its own or of several."""

    line: str
    series: str
    colour: str
    symbol: str  # Plotly's: full, open for TOM as printed, a diamond for half uniform weights
    value: float
    low: float
    high: float


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


def tables_of(study: Study) -> Tables:
    read = ((path.stem, studies.table(path)) for path in study.tables)
    return {
        name: [dict(row) for row in table.to_dict("records")]
        for name, table in read
        if table is not None
    }


def verdict(study: Study) -> Verdict | None:
    """The verdict on a study's question; None without a rule for it, or without its tables."""
    try:
        rule = _factors if study.has_factors else RULES[study.verb]
        return rule(tables_of(study))
    except (LookupError, ValueError, StopIteration):  # or tables of another version
        return None


def _footprint(tables: Tables) -> Verdict:
    rows = {row["way"]: row for row in tables["summary"]}
    ours = []
    for row in (rows[way] for way in (PRINTED, MENDED) if way in rows):
        signs = sign_test(
            (one["env"], one["recording"], 1 - one["footprint"])
            for one in informative_outcomes(tables["moments"])
            if one["way"] == row["way"]
        )
        ours.append({**row, "p": signs.p, "better on": signs.above, "recordings": signs.n})
    distances = [
        f"{LABELS[row['way']]} {percent(row['distance'], 0)} "
        f"({_certainty(row, lambda end: percent(end, 0))})"
        for row in ours
    ]
    sentence = (
        "A weighted buffer keeps this share of its distance to what the policy does next: "
        f"{', '.join(distances)}. Recorded trainings, {ours[0]['n']:.0f} moments."
    )
    rivals = {"recency": "Recency", "policy-distance": "The policies' distance"}
    rival_sentences = [
        f"{name}, which trains nothing, keeps {percent(rows[rival]['distance'], 0)}, which "
        f"{_comparison(pair, rival)} TOM mended ({_certainty(pair, lambda end: percent(end, 0))})."
        for pair in tables["head-to-head"]
        for rival, name in rivals.items()
        if {pair["way"], pair["against"]} == {MENDED, rival}
    ]
    shown = sorted((rows[way] for way in LABELS if way in rows), key=lambda row: row["distance"])
    points = [_point(LABELS[row["way"]], "", row, "distance") for row in shown]
    axis = "distance to the policy (1: without weights)"
    return Verdict(_by_rows(ours), sentence, " ".join(rival_sentences), axis, 1, points)


def _comparison(pair: Row, rival: str) -> str:
    """How a way's distance lies beside the other's of a pair, by the interval of the difference."""
    differs = pair["p"] < SIGNIFICANT
    if isfinite(pair["low"]):
        differs = pair["low"] > 0 or pair["high"] < 0
    if not differs:
        return "cannot be told from"
    further = (pair["difference"] > 0) == (pair["way"] == rival)
    return "is further away than" if further else "is nearer than"


def _capacity(tables: Tables) -> Verdict:
    pairs = [row for row in tables["head-to-head"] if row["against"] == UNIFORM]
    table = [row for row in pairs if row["way"] in LABELS]
    of_tom = [row for row in table if row["way"] in (PRINTED, MENDED)]
    ours, whose = (of_tom, "TOM's") if of_tom else (table, "These")
    models = list(dict.fromkeys(row["model"] for row in ours))
    less = [m for m in models if all(row["high"] < 1 for row in ours if row["model"] == m)]
    cost = [
        f"{row['ratio']:.2f} ({_certainty(row, '{:.2f}'.format)}) with {LABELS[row['way']]}"
        for row in table
        if row["model"] == models[-1] and not WAYS[row["way"]].half
    ]
    sentence = (
        f"{whose} weights lower the model's error where the policy goes for "
        f"{' and '.join(less) or 'no model'} (units x layers). The error of {models[-1]} over that "
        f"with uniform weights is {' and '.join(cost)}."
    )
    least = min(1.0, min(row["p"] for row in table) * len(table))
    against = f"Corrected for all {len(table)} tests of the table, the smallest p is {least:.2g}."
    points = [_point(row["model"], LABELS[row["way"]], row, "ratio") for row in table]
    axis = "model error (1: as with uniform weights)"
    return Verdict(_by_rows(ours), sentence, against, axis, 1, points)


def _improvement(tables: Tables) -> Verdict:
    difference = "difference, weights"
    table = [row for row in tables["summary"] if row["what"].startswith(difference)]
    sides = [_side(row["p"] * len(table), 2 * row["better in trials"] > row["n"]) for row in table]
    for row in table:
        row["what"] = row["what"].replace(difference, LABELS.get(row["way"], row["way"]))
        row["share"] = row["better in trials"] / row["n"]
    trials = [
        f"{row['better in trials']:.0f} of {row['n']:.0f} trials ({row['what']})"
        for row in sorted(table, key=lambda row: row["share"])
    ]
    sentence = (
        f"After one fit, the policy returned more than with uniform weights in {trials[0]} to "
        f"{trials[-1]}; the smallest p of {len(table)} tests is {min(r['p'] for r in table):.2g}."
    )
    against = (
        f"At most {max(row['recordings'] for row in table):.0f} recordings count in a test: only "
        "a large effect of weights could have been seen."
    )
    points = [_point(row["what"], "", row, "share") for row in table]
    return Verdict(word_of(sides), sentence, against, "share of trials returning more", 0.5, points)


def _returns(tables: Tables) -> Verdict:
    of_tom = {"TOM": LABELS[PRINTED], "TOM, mended": LABELS[MENDED]}
    shown = {label: label for label in BY_LABEL} | of_tom
    pairs = [row for row in tables["improvement"] if row["against"] == "MLE"]
    table = [row for row in pairs if row["learner"] in shown]
    ours = [row for row in table if row["learner"] in of_tom]
    sides = [_side(row["p of all"], row["wins"] > 0.5) for row in ours]
    chances = [
        f"{shown[row['learner']]} {10 * row['wins']:.0f} times in 10 (p {row['p']:.2g})"
        for row in ours
        if row["by"] == "best return"
    ]
    sentence = f"By best return, a random run beats a random run of MLE: {', '.join(chances)}."
    least = min(row["p of all"] for row in ours)
    remarks = (row["remark"] for row in ours if isinstance(row["remark"], str))
    few = next((f" {one[0].upper()}{one[1:]}." for one in remarks), "")
    against = f"Corrected for all comparisons of the table, the smallest p is {least:.2g}.{few}"
    points = [
        Point(
            row["by"], shown[row["learner"]],
            learner_colour(BY_LABEL[row["learner"].removesuffix(", mended")]),
            "circle-open" if row["learner"] == "TOM" else "circle",
            row["wins"], row["low"], row["high"],
        )
        for row in table
    ]  # fmt: skip
    axis = "a random run beats one of MLE"
    return Verdict(word_of(sides), sentence, against, axis, 0.5, points)


def _factors(tables: Tables) -> Verdict:
    """By the mean height of the curves, the p corrected for all tests of the table."""
    tested = [row for row in tables[FACTORS] if isfinite(row["p"])]
    rows = [row for row in tested if row["by"] == MEASURES[HEIGHT]]
    found = [
        f"{row['effect of']} {row['effect']:+.0f} ({row['low']:+.0f} to {row['high']:+.0f}, "
        f"p {row['p']:.2g})"
        for row in rows
    ]
    sentence = f"Mean return over a training: {', '.join(found)}."
    few = next((f"; {row['remark']}" for row in rows if isinstance(row["remark"], str)), "")
    p = ", ".join(f"{row['p of all']:.2g}" for row in rows)
    against = f"Corrected for all {len(tested)} tests of the table, p is {p}. One task{few}."
    colour = learner_colour(SUBJECT)
    points = [
        Point(row["effect of"], "", colour, "circle", row["effect"], row["low"], row["high"])
        for row in rows
    ]
    sides = [_side(row["p of all"], row["effect"] > 0) for row in rows]
    return Verdict(word_of(sides), sentence, against, "return more", 0, points)


def _focus(tables: Tables) -> Verdict:
    names = {"pmac": "PMAC", "tom paper": LABELS[PRINTED], "tom mended": LABELS[MENDED],
             "tom exact": "TOM exact"}  # fmt: skip
    rows = [row for row in tables["summary"] if row["rival"] in names]
    ours = [row for row in rows if row["rival"].startswith("tom")]
    signs = {
        names[name]: sign_test(
            ("", row["recording"], 1 - row["policy / mle"]) for row in ours if row["rival"] == name
        )
        for name in dict.fromkeys(row["rival"] for row in ours)
    }
    sides = [_side(one.p * len(signs), 2 * one.above > one.n) for one in signs.values()]
    counts = [f"{name} on {one.above} of {one.n}" for name, one in signs.items()]
    sentence = (
        "On new steps of the policy, the model errs less than MLE's: "
        f"{', '.join(counts)} recordings (smallest p {min(one.p for one in signs.values()):.2g})."
    )
    least = min(1.0, 2.0 ** (1 - max(one.n for one in signs.values())))
    against = (
        "On the buffer's random half, the error is "
        f"{median(row['random / mle'] for row in ours):.2f} times MLE's (median). With so few "
        f"recordings, p cannot be below {least:.2g}."
    )
    points = [
        Point(row["recording"], names[row["rival"]],
              learner_colour(row["rival"].partition(" ")[0]),
              "circle-open" if row["rival"] == "tom paper" else "circle",
              row["policy / mle"], nan, nan)
        for row in rows
    ]  # fmt: skip
    axis = "model error where the policy goes (1: as MLE's)"
    return Verdict(word_of(sides), sentence, against, axis, 1, points)


def _online(tables: Tables) -> Verdict:
    of_tom = {"TOM": LABELS[PRINTED], "TOM, mended": LABELS[MENDED]}
    rows = [row for row in tables["online"] if row["learner"] in of_tom]
    uneven = [row["excess there"] for row in rows if isfinite(row["excess there"])]
    early = sum(share < 0.5 for share in uneven)
    sentence = (
        f"In {early} of {len(uneven)} profiles most of the weight above even weights lies before "
        "the newest tenth of the buffer, which has "
        f"{percent(median(row['newest tenth'] for row in rows), 0)} of all weight (median)."
    )
    runs = {row["run"] for row in rows}
    against = (
        f"{len(runs)} runs, one seed each, so there is no test. The latest profile is of step "
        f"{max(row['step'] for row in rows):,}; the paper's are of steps 120,000 and 200,000."
    )
    points, colour = [], learner_colour(SUBJECT)
    for env, name in dict.fromkeys((row["env"], row["learner"]) for row in rows):
        shares = [r["newest tenth"] for r in rows if (r["env"], r["learner"]) == (env, name)]
        mark = "circle-open" if name == "TOM" else "circle"
        value = median(shares)
        points.append(Point(run_names.task_title(env), of_tom[name], colour, mark, value, nan, nan))
    axis = "weight on the newest tenth (0.1: even weights)"
    side = (2 * early > len(uneven)) - (2 * early < len(uneven))
    word = {1: "Yes", 0: "In part", -1: "No"}[side]
    return Verdict(word, sentence, against, axis, 0.1, points)


def _accepted(tables: Tables) -> Verdict:
    """By the numbers of the acceptance, which has no figure of its own."""
    judged = [row for row in tables["checks"] if str(row["met"]) in ("True", "False")]
    missed = [str(row["name"]) for row in judged if str(row["met"]) == "False"]
    met = len(judged) - len(missed)
    sentence = f"{met} of the {len(judged)} bounds that were fixed beforehand are met."
    more = f", and {len(missed) - MAX_NAMED} more" if len(missed) > MAX_NAMED else ""
    against = f"Not met: {'; '.join(missed[:MAX_NAMED])}{more}." if missed else ""
    return Verdict(word_of([1] * met + [-1] * len(missed)), sentence, against)


ACCEPTED = "road", "progression", "tabular"
RULES: dict[str, Callable[[Tables], Verdict]] = dict.fromkeys(ACCEPTED, _accepted) | {
    "focus": _focus,
    "footprint": _footprint,
    "capacity": _capacity,
    "improvement": _improvement,
    "online": _online,
    "returns": _returns,
}


def _by_rows(rows: Sequence[Row]) -> str:
    """The word for rows of a quantity that is better below 1, by their intervals or tests."""

    def side(row: Row) -> int:
        if isfinite(row["low"]):
            return (row["high"] < 1) - (row["low"] > 1)
        return _side(row["p"] * len(rows), 2 * row["better on"] > row["recordings"])

    return word_of([side(row) for row in rows])


def _side(p: float, better: bool) -> int:
    """The outcome of a test by its corrected p: 1 for better, -1 for worse, 0 for neither."""
    return (1 if better else -1) if p < SIGNIFICANT else 0


def _certainty(row: Row, number: Callable[[float], str]) -> str:
    """How sure a row's number is: its interval, else its test."""
    if isfinite(row["low"]):
        of = "difference " if "difference" in row else ""
        return f"{of}{number(row['low'])} to {number(row['high'])}"
    return f"p {row['p']:.2g}, {row['recordings']:.0f} recordings"


def word_of(sides: Sequence[int]) -> str:
    """The word for comparisons: 1 is better, -1 worse, 0 neither. Raises ValueError without any."""
    if not sides:
        raise ValueError("nothing to judge")
    if not any(sides):
        return "No difference seen"
    if min(sides) == 1:
        return "Yes"
    return "In part" if max(sides) == 1 else "No"


def _point(line: str, series: str, row: Row, column: str) -> Point:
    """The point of a row's way, at the value in `column`."""
    ends = row.get("low", nan), row.get("high", nan)
    colour = learner_colour(WAYS[row["way"]].learner or "")
    return Point(line, series, colour, symbol(row["way"]), row[column], *ends)


def symbol(way: str) -> str:
    """The marker of a way: half uniform weights and TOM as printed have their own."""
    if WAYS[way].half:
        return "diamond-wide"
    return "circle-open" if way == PRINTED else "circle" if WAYS[way].label else "x"
