"""One study of moments with three measures: what `footprint`, `capacity` and `improvement` share.

Their options, the table of their outcomes (`moments.csv`), and statistics in which the recordings
count: moments of one recording are alike. What a moment is, and the ways of weighing, are in
`tom.studies.frozen`.
"""

import json
from argparse import ArgumentParser, Namespace
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from math import isfinite, nan
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any, NamedTuple

import pandas as pd
from scipy.stats import binomtest

from tom.analysis.statistics import Interval, interval, mean
from tom.envs import ENVS, task, task_rank
from tom.errors import UserError, check_known, reason
from tom.exams import informative
from tom.readable import whole
from tom.record import RunReader, Store
from tom.reports.report import WORDS, in_short
from tom.studies.frozen import ERROR, NEWEST, UNIFORM, WAYS, cases, examine, moments
from tom.studies.study import (
    Findings,
    Row,
    add_jobs,
    add_runs,
    compute,
    tasks,
)
from tom.studies.verdicts import Point, side, word_of

if TYPE_CHECKING:  # the studio reads outcomes without loading matplotlib
    from matplotlib.figure import Figure

KINDS: Mapping[Any, Any] = {"recording": str, "env": str, "step": int, "way": str, "seed": int}
MEASURES = ("ess", "ends", "ends_policy", "footprint", "footprint_uniform", "footprint_noise")
"""the columns of an outcome: the types of those that are no measures, and the measures"""
MEASURED = "measured: "
"""begins what a report that was made anew says of the origin of its outcomes"""


def add_moment_options(parser: ArgumentParser, ways: Sequence[str]) -> None:
    """Add the options that choose runs, their moments, and ways of weighing."""
    parser.add_argument(
        "runs", nargs="*", metavar="RUN", help="[every run in the store that can be used]"
    )
    add_runs(parser, ENVS, "[all of ours]")
    parser.add_argument("--moments", type=whole(1), default=8, help="maximum per run [8]")
    parser.add_argument("--seeds", nargs="+", type="seed", default=[0], help="[0]")
    known = ", ".join(WAYS)
    parser.add_argument("--ways", nargs="+", default=list(ways), metavar="WAY", help=known)
    add_jobs(parser)


def chosen_ways(args: Namespace) -> list[str]:
    """The ways of weighing, uniform weights first. Raises UserError for an unknown one."""
    check_known("way of weighing", args.ways, WAYS)
    return list(dict.fromkeys((UNIFORM, *args.ways)))


def chosen_runs(args: Namespace) -> list[RunReader]:
    """The runs with moments, of any task.

    Raises UserError if there are none, or a named run has none or is of a task that is not known.
    """
    store, envs = Store(args.store), tasks(args.env)
    named = [store.run(name) for name in args.runs]
    able = [
        run
        for run in named or store.runs()
        if (named or run.env in envs) and "buffer" not in run.left_out and moments(run, 1)
    ]
    if lacking := [run.run_id for run in named if run not in able]:
        raise UserError(
            f"{', '.join(lacking)} has no moment: no policy of a fit at least {NEWEST:,} steps "
            "after exploration, or no buffer"
        )
    if not able:
        raise UserError(
            f"{args.store}/ has no run with a buffer and policies of fits at least {NEWEST:,} "
            "steps after exploration: "
            f"tom record-sac --env {min(envs, key=task_rank)} --steps 20000 makes one"
        )
    for run in named:
        task(run.env)
    return sorted(able, key=lambda run: (task_rank(run.env), run.run_id))


def add_measure_options(
    parser: ArgumentParser, ways: Sequence[str], models: Sequence[str] = ()
) -> None:
    """Add the options of a study that weighs moments, or reads the table of one that did."""
    add_moment_options(parser, ways)
    parser.add_argument("--rows", type=whole(100), default=6000, help="new transitions [6000]")
    if models:
        known = ", ".join(f"'{name}'" for name in models)
        parser.add_argument("--models", nargs="+", default=list(models), help=f"[{known}]")
    parser.set_defaults(usual=vars(parser.parse_args([])))
    parser.add_argument(
        "--from", dest="table", type=Path, metavar="FILE",
        help="moments.csv of an earlier report: only remake its tables and figures",
    )  # fmt: skip


def outcomes_of(args: Namespace, models: Sequence[str] = ()) -> list[Row]:
    """The outcome of every case, or those of an earlier report, to the bit.

    Raises UserError for a table that is none, or options that have no meaning beside one.
    """
    if not args.table:
        requested = cases(
            chosen_runs(args), chosen_ways(args), args.seeds, args.moments, models, args.rows
        )
        return compute(args, examine, requested, outcome_label)
    if given := [name for name, usual in args.usual.items() if getattr(args, name) != usual]:
        raise UserError(
            "--from takes all that its file holds, as it was measured: leave out: "
            f"{', '.join(given)}"
        )
    try:
        table = pd.read_csv(args.table, dtype=KINDS, float_precision="round_trip")
        outcomes = [dict(row) for row in table.to_dict("records")]
        if {*KINDS, *MEASURES}.difference(table):
            raise ValueError("it has no outcome")
    except OSError as error:
        raise UserError(f"cannot read {args.table}: {error}") from error
    except ValueError as error:
        why = reason(error)
        raise UserError(f"{args.table} is not a moments.csv of this study ({why})") from error
    return outcomes


def outcome_label(one: Row) -> str:
    """Names an outcome in the line of progress."""
    return f"{one['recording']} at {one['step']}: {one['way']}"


def models_of(outcomes: Sequence[Row]) -> list[str]:
    """The models whose errors the outcomes have."""
    columns = dict.fromkeys(name for one in outcomes for name in one if name.startswith(ERROR))
    return [name.removeprefix(ERROR) for name in columns]


def findings(
    args: Namespace,
    sentences: Sequence[str],
    tables: Mapping[str, Sequence[Row]],
    outcomes: Sequence[Row],
    figures: Mapping[str, tuple[str, "Figure"]],
) -> Findings:
    """What a study of moments found, with the origin of its outcomes."""
    recordings = dict.fromkeys(one["recording"] for one in outcomes)
    at = {(one["recording"], one["step"]) for one in outcomes}
    origin = {
        "n": f"{len(at)} moments of {len(recordings)} runs",
        "seeds": in_short([one["seed"] for one in outcomes]),
        "runs": ", ".join(recordings),
    }
    table = getattr(args, "table", None)
    if table and (table.parent / WORDS).is_file():  # how the table was measured that was read
        old = json.loads((table.parent / WORDS).read_text())["origin"]
        first = {key: text for key, text in old.items() if key.startswith(MEASURED)}
        origin |= first or {MEASURED + key: text for key, text in old.items()}
    titles = {"summary": "Every way", "head-to-head": "Two ways at the same moments"}
    shown = {name: title for name, title in titles.items() if name in tables}
    return Findings(sentences, {**tables, "moments": outcomes}, shown, figures, origin=origin)


# What is measured at a moment.


def informative_outcomes(outcomes: Sequence[Row]) -> list[Row]:
    """The outcomes whose distance was measured and is not lost in its noise (`informative`)."""
    says = informative([one["footprint_noise"] for one in outcomes])
    both = zip(outcomes, says, strict=True)
    return [one for one, kept in both if kept and isfinite(one["footprint"])]


def ratios(outcomes: Sequence[Row], ahead: str) -> Iterator[tuple[Row, str, float]]:
    """(outcome, model, its error relative to uniform weights at the same moment and seed)."""
    base = {trial_of(one): one for one in outcomes if one["way"] == UNIFORM}
    for one in outcomes:
        if one["way"] != UNIFORM and (uniform := base.get(trial_of(one))):
            for model in models_of([one]):
                yield one, model, one[ahead + model] / uniform[ahead + model]


def trial_of(one: Row) -> tuple[str, int, int]:
    """What two ways of weighing share: recording, step and seed."""
    return one["recording"], one["step"], one["seed"]


# Statistics over recordings.

Value = tuple[str, str, float]
"""task, recording, and a value at one of its moments"""

QUESTIONS: dict[tuple[str, str], str] = {
    ("tom-discounted", "uniform"): "Is TOM as printed better than no weights?",
    ("tom-mended", "uniform"): "Is the mended one?",
    ("half-tom-mended", "uniform"): "Is it, if half of its weight is uniform?",
    ("half-recency", "uniform"): "Is recency, if half of its weight is uniform?",
    ("tom-mended", "tom-discounted"): "Is the mended objective better than the printed one?",
    ("tom-mended", "ratio"): "Does Q bring something on top of the discriminator?",
    ("tom-mended", "recency"): "Is TOM better than recency, which trains no network?",
    ("half-tom-mended", "half-recency"): "Is it better than recency, if half of either is uniform?",
    ("policy-distance", "recency"): "Is the policy's distance at each row better than recency?",
    ("policy-distance", "tom-mended"): "Is it better than TOM mended, which trains two networks?",
    ("policy-distance", "uniform"): "Is it better than no weights?",
    ("pmer", "uniform"): "Are rows of large error better than no weights?",
    ("tom-stationary-validated", "tom-stationary"): "Is it better to stop Q on held-out episodes?",
    ("tom-stationary-validated", "tom-discounted-validated"): "Does the flow matter?",
}
"""what is asked of two ways: the first one, and the one that it has to beat

Those of policy distance and PMER were written down on 2026-11-27, before any result was read: on
the same moments, is policy distance nearer to the policy (`footprint`) than recency and `mended`,
and is the error of its model there lower than that of uniform weights at 200 x 4 (`capacity`)? Does
PMER lower that error?
"""


class Signs(NamedTuple):
    """On how many of `n` recordings a difference is above zero, and the sign test's p."""

    above: int
    n: int
    p: float


def sign_test(differences: Iterable[Value]) -> Signs:
    """Exact two-sided sign test over recordings; one counts by most of its moments.

    Recordings with as many moments above as below zero do not count. Unlike a bootstrap interval it
    is right for few recordings.
    """
    balance: dict[tuple[str, str], int] = {}
    for env, recording, value in differences:
        sign = (value > 0) - (value < 0)
        balance[env, recording] = balance.get((env, recording), 0) + sign
    above, n = sum(v > 0 for v in balance.values()), sum(v != 0 for v in balance.values())
    return Signs(above, n, float(binomtest(above, n).pvalue) if n else 1.0)


def over_recordings(values: Iterable[Value]) -> Interval:
    """Mean over tasks of the mean over recordings of the median over moments.

    The bootstrap interval resamples recordings within each task; its bounds are NaN if a task has
    only one. Raises ValueError if there is no value.
    """
    moments: dict[str, dict[str, list[float]]] = {}
    for env, recording, value in values:
        moments.setdefault(env, {}).setdefault(recording, []).append(value)
    return interval([[median(of) for of in each.values()] for each in moments.values()], mean)


def comparisons(
    outcomes: Sequence[Row],
    value: Callable[[Row], float],
    measure: str,
    better_at: str,
    **more: str,
) -> Iterator[Row]:
    """A row for each of `QUESTIONS`, over the moments that both ways were examined at.

    `value` is what is compared, lower is better; moments where it is NaN do not count. The
    difference at a moment is the median over seeds. `measure` and `better_at` are the titles of the
    difference, which is a mean over tasks, and of the moments where the first way is better; the
    difference in each task is under its name, NaN without a moment there.
    """
    at = {(one["way"], *trial_of(one)): value(one) for one in outcomes}
    envs = dict.fromkeys(one["env"] for one in outcomes)
    for way, against in QUESTIONS:
        trials: dict[tuple[str, str, int], list[float]] = {}
        for one in outcomes:
            gap = value(one) - at.get((against, *trial_of(one)), nan)
            if one["way"] == way and isfinite(gap):
                trials.setdefault((one["env"], one["recording"], one["step"]), []).append(gap)
        gaps: list[Value] = [(env, run, median(each)) for (env, run, _), each in trials.items()]
        if not gaps:
            continue
        whole, signs = over_recordings(gaps), sign_test(gaps)
        in_task = {env: [gap for gap in gaps if gap[0] == env] for env in envs}
        yield {
            "way": way,
            "against": against,
            **more,
            **whole.columns(measure),
            better_at: sum(gap < 0 for _, _, gap in gaps),
            "n": len(gaps),
            "better on": signs.n - signs.above,
            "recordings": signs.n,
            "p": signs.p,
            **{env: over_recordings(of).value if of else nan for env, of in in_task.items()},
        }


def answer_sentences(pairs: Sequence[Row], measure: str, better_at: str) -> list[str]:
    """The rows of `comparisons` in words, a sentence for each question."""
    comparisons_of: dict[tuple[str, str], list[str]] = {}
    for row in pairs:
        comparisons_of.setdefault((row["way"], row["against"]), []).append(
            f"{row.get('model', '')} {with_interval(row, measure)} ({better_at} {row[better_at]} "
            f"of {row['n']} moments, most of them on {row['better on']} of {row['recordings']} "
            f"recordings, sign test p = {row['p']:.2f})".lstrip()
        )
    return [
        f"{QUESTIONS[way, against]} {measure} of {way} and {against}: {'; '.join(sentences)}."
        for (way, against), sentences in comparisons_of.items()
    ]


def with_interval(row: Row, name: str) -> str:
    """The number of a row with its interval, in words."""
    bounds = f" [{row['low']:.2f}, {row['high']:.2f}]" if isfinite(row["low"]) else ""
    return f"{row[name]:.2f}{bounds}"


# Verdicts.


def word_of_rows(rows: Sequence[Row]) -> str:
    """The word for rows with a sign test each, which are judged by it.

    Where all differ alike, every p has to be below .05; else p is corrected for their number.
    """

    def sides(tests: int) -> list[int]:
        return [side(row["p"] * tests, 2 * row["better on"] > row["recordings"]) for row in rows]

    alike = abs(sum(sides(1))) == len(rows)
    return word_of(sides(1 if alike else len(rows)))


def of_test(row: Row) -> str:
    """A row's sign test in words."""
    return f"p {row['p']:.2g}, {row['recordings']:.0f} recordings"


def against_intervals(rows: Sequence[Row]) -> str:
    """What speaks against the intervals of rows: the smallest p of their tests, corrected."""
    least = min(1.0, min(row["p"] for row in rows) * len(rows))
    what = f"Corrected for {len(rows)} tests over all recordings, the smallest p is {least:.2g}"
    return f"{what}: intervals over so few are too narrow."


def way_point(row: Row, column: str, line: str, series: str = "") -> Point:
    """The point of a row's way, at the value in `column`."""
    way, ends = row["way"], (row.get("low", nan), row.get("high", nan))
    return Point(line, series, row[column], *ends, WAYS[way].learner or "", way)
