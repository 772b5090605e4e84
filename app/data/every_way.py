"""Every way of weighing on two axes: how near it is to the policy, and how much its model errs.

The distances are those of the footprint study, the errors those of the capacity study: of the
paper's model, on new steps of the policy, over the error under uniform weights.
"""

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from math import exp, log

from app.data import called, studies
from app.data.studies import Study
from app.data.verdicts import LABELS, word_of
from tom.analysis.statistics import COVERAGE, Interval
from tom.studies.frozen import ERROR, MODELS, UNIFORM, WAYS
from tom.studies.moments import over_recordings, ratios, telling, trial_of
from tom.studies.study import Row

QUESTION = "Does weighing nearer to the policy make the paper's model better there?"
MODEL = list(MODELS)[-1]
"""the paper's"""
Measured = Sequence[tuple[Row, float]]
"""outcomes of ways at moments, with the number that counts"""


@dataclass(frozen=True)
class Placed:
    """A way of weighing in one task; both numbers are 1 for uniform weights, less is better."""

    way: str
    distance: Interval
    error: Interval


@dataclass(frozen=True)
class Panel:
    """One task: its ways, uniform weights first, and the number of recordings and moments."""

    env: str
    ways: Sequence[Placed]
    recordings: int
    moments: int


@dataclass(frozen=True)
class EveryWay:
    """The tasks that both studies have, and the answer to `QUESTION`."""

    panels: Sequence[Panel]
    word: str
    sentence: str
    against: str
    caption: str
    """what is drawn, n, and what is left out"""


def every_ways(listed: Sequence[Study]) -> dict[str, EveryWay]:
    """`every_way` of each footprint study with the capacity study whose name ends alike, by that
    ending: `footprint` goes with `capacity`, `footprint-ways` with `capacity-ways`."""
    alike: dict[str, list[Study]] = {}
    for study in listed:
        alike.setdefault(study.name.removeprefix(study.verb), []).append(study)
    found = {ending: every_way(of) for ending, of in alike.items()}
    return {ending: one for ending, one in found.items() if one is not None}


def every_way(listed: Sequence[Study]) -> EveryWay | None:
    """The ways at the moments that both studies have; None without such moments."""
    tables = {
        study.verb: table
        for study in reversed(listed)  # of two of a kind the first counts
        for path in study.tables
        if path.stem == "moments" and (table := studies.table(path)) is not None
    }
    try:
        near, errs = (
            [dict(row) for row in tables[name].to_dict("records")]
            for name in ("footprint", "capacity")
        )
        shared = {*map(trial_of, near)} & {*map(trial_of, errs)}
        near, errs = ([row for row in rows if trial_of(row) in shared] for rows in (near, errs))
        distances = [(row, row["footprint"]) for row in telling(near)]
        errors = [(row, log(r)) for row, model, r in ratios(errs, ERROR) if model == MODEL]
    except (KeyError, ValueError):  # not computed, or tables of another version
        return None
    every = (_panel(env, distances, errors) for env in dict.fromkeys(row["env"] for row in errs))
    panels = [panel for panel in every if len(panel.ways) > 1]
    if not panels:
        return None
    one_sided = {row["way"] for row in near} ^ {row["way"] for row in errs}
    return EveryWay(panels, *_answer(panels), _caption(panels, one_sided))


def _panel(env: str, distances: Measured, errors: Measured) -> Panel:
    """A recording's number is the median over its moments, the task's the mean over recordings, of
    errors that of their logarithms; the intervals resample recordings."""
    near, errs = (
        {
            way: over_recordings((env, row["recording"], x) for row, x in of if row["way"] == way)
            for way in WAYS
            if any(row["way"] == way for row, _ in of)
        }
        for of in (
            [(row, x) for row, x in every if row["env"] == env] for every in (distances, errors)
        )
    )
    even = Interval(1, 1, 1)
    ways = [
        Placed(way, near[way], Interval(*map(exp, (e.value, e.low, e.high))))
        for way, e in errs.items()
        if way in near
    ]
    moments = {(row["recording"], row["step"]) for row, _ in errors if row["env"] == env}
    recordings = {recording for recording, _ in moments}
    return Panel(env, [Placed(UNIFORM, even, even), *ways], len(recordings), len(moments))


def _answer(panels: Sequence[Panel]) -> tuple[str, str, str]:
    """A word, a sentence, and what speaks against it.

    A task says yes if a way has both intervals below uniform weights, no if each errs more.
    """
    yes, no, told = 0, 0, []
    for panel in panels:
        ways = panel.ways[1:]
        both = [LABELS.get(p.way, p.way) for p in ways if p.distance.high < 1 and p.error.high < 1]
        all_worse = all(p.error.low > 1 for p in ways)
        yes, no = yes + bool(both), no + all_worse
        none = "none, all err more" if all_worse else "none"
        told.append(f"{called.task(panel.env)}: {', '.join(both) or none}.")
    sentence = (
        "Both nearer to the policy and of smaller error than uniform weights, by their intervals. "
        + " ".join(told)
    )
    counts = sorted({panel.recordings for panel in panels} & {*COVERAGE})
    few = (
        f", with {counts[0]} about {COVERAGE[counts[0]]} of 100 hold the true mean"
        if counts
        else ""
    )
    alone = [called.task(panel.env) for panel in panels if panel.recordings == 1]
    none = f" One recording, of {' and '.join(alone)}, gives none." if alone else ""
    against = (
        f"Intervals over so few recordings are too narrow{few}, and "
        f"{2 * sum(len(panel.ways) - 1 for panel in panels)} are read at once, uncorrected.{none}"
    )
    return word_of(yes, no, len(panels)), sentence, against


def _caption(panels: Sequence[Panel], one_sided: Collection[str]) -> str:
    """`one_sided` are the ways that only one of the two studies has."""
    n = ", ".join(
        f"{called.task(p.env)} {p.moments} moments of {p.recordings} recording"
        + "s" * (p.recordings > 1)
        for p in panels
    )
    named = [label for way, label in LABELS.items() if way in one_sided]
    if variants := len(one_sided) - len(named):
        named.append(f"{variants} variants of TOM")
    left_out = f" Left out, since one number is lacking: {', '.join(named)}." if named else ""
    return (
        "Uniform weights are at 1 on both axes; further left is nearer to the policy, further down "
        f"errs less. Model: {MODEL} (units x layers), one step ahead. Bars: 95 % bootstrap "
        f"intervals over recordings. n: {n}.{left_out}"
    )
