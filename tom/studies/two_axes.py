"""Every way of weighing on two axes: its distance to the policy, and the error of its model there.

One question that a footprint study and a capacity study of the same moments answer together.
"""

from collections.abc import Collection, Sequence
from math import exp, log

from tom.analysis.statistics import Interval
from tom.readable import task_title
from tom.studies.frozen import ERROR, LABELS, MODELS, UNIFORM, WAYS
from tom.studies.moments import (
    Value,
    against_intervals,
    informative_outcomes,
    over_recordings,
    ratios,
    sign_test,
    trial_of,
    word_of_rows,
)
from tom.studies.study import Row
from tom.studies.verdicts import Panel, Verdict

QUESTION = "Does weighing nearer to the policy make the paper's model better there?"
PAPER_MODEL = list(MODELS)[-1]
"""the paper's model"""
Outcome = tuple[Row, float]
"""a row of a moment, with the number that counts"""


def verdict(near: Sequence[Row], errs: Sequence[Row]) -> Verdict:
    """The answer to `QUESTION` by the moments of a footprint study and of a capacity study.

    What counts are the moments of both. Raises ValueError without any, and KeyError for tables of
    another version.
    """
    shared = {*map(trial_of, near)} & {*map(trial_of, errs)}
    near, errs = ([row for row in rows if trial_of(row) in shared] for rows in (near, errs))
    distances = [(row, row["footprint"]) for row in informative_outcomes(near)]
    errors = [(row, log(r)) for row, model, r in ratios(errs, ERROR) if model == PAPER_MODEL]
    every = (_panel(env, distances, errors) for env in {row["env"]: 0 for row in errs})
    panels = [panel for panel in every if len(panel.ways) > 1]
    one_sided = {row["way"] for row in near} ^ {row["way"] for row in errs}
    ways = {row["way"] for row, _ in errors} - one_sided
    tests = [_test(way, distances, errors) for way in ways]
    return Verdict(*_answer(panels, tests), panels=panels, caption=_caption(panels, one_sided))


def _test(way: str, distances: Sequence[Outcome], errors: Sequence[Outcome]) -> Row:
    """The sign test of a way over recordings: does it err less, and is it nearer?

    It has to do both, so the larger p counts; of a way that errs more, that of its errors.
    """
    nearer, less = (
        sign_test(
            (row["env"], row["recording"], level - value)
            for row, value in outcomes
            if row["way"] == way
        )
        for outcomes, level in ((distances, 1), (errors, 0))
    )
    near = nearer.p if 2 * nearer.above > nearer.n else 1
    p = max(less.p, near) if 2 * less.above > less.n else less.p
    return {"p": p, "better on": less.above, "recordings": less.n}


def _panel(env: str, distances: Sequence[Outcome], errors: Sequence[Outcome]) -> Panel:
    """A task's ways by the distances and by the logarithms of the errors at its moments.

    By way the mean over recordings of the median over moments; intervals resample recordings. n is
    the smaller of both, since a distance that is noise does not count.
    """
    near, errs = dict[str, list[Value]](), dict[str, list[Value]]()
    for outcomes, of_way in ((distances, near), (errors, errs)):
        for row, value in outcomes:
            if row["env"] == env:
                of_way.setdefault(row["way"], []).append((env, row["recording"], value))
    even = Interval(1, 1, 1)
    ways = [(UNIFORM, even, even)]
    for way in (way for way in WAYS if way in near and way in errs):
        error = over_recordings(errs[way])
        ends = Interval(exp(error.value), exp(error.low), exp(error.high))
        ways.append((way, over_recordings(near[way]), ends))
    counted = [
        {(row["recording"], row["step"]) for row, _ in outcomes if row["env"] == env}
        for outcomes in (distances, errors)
    ]
    recordings = min(len({recording for recording, _ in moments}) for moments in counted)
    return Panel(env, ways, recordings, min(map(len, counted)))


def _answer(panels: Sequence[Panel], tests: Sequence[Row]) -> tuple[str, str, str]:
    """A word by the tests, what the tasks' intervals say, and what speaks against it."""
    word, per_task = word_of_rows(tests), []
    for panel in panels:
        both = [LABELS.get(way, way) for way, *of in panel.ways if all(one.high < 1 for one in of)]
        per_task.append(f"{task_title(panel.env)}: {', '.join(both) or 'none'}.")
    sentence = (
        "By their intervals, these are nearer to the policy than uniform weights and also err "
        "less. " + " ".join(per_task)
    )
    return word, sentence, against_intervals(tests)


def _caption(panels: Sequence[Panel], one_sided: Collection[str]) -> str:
    """`one_sided` are the ways that only one of the two studies has."""
    n = ", ".join(
        f"{task_title(p.env)} {p.moments} moment{'s' * (p.moments > 1)} of "
        f"{p.recordings} recording{'s' * (p.recordings > 1)}"
        for p in panels
    )
    named = [label for way, label in LABELS.items() if way in one_sided]
    if variants := len(one_sided) - len(named):
        named.append(f"{variants} variants of TOM")
    left_out = f" Left out, for lack of one number: {', '.join(named)}." if named else ""
    return (
        "Uniform weights are at 1 on both axes. Further left is nearer to the policy, further down "
        f"is a smaller error. Model: {PAPER_MODEL} (units x layers), one step ahead. Bars: 95 % "
        f"bootstrap intervals over recordings. n: {n}.{left_out}"
    )
