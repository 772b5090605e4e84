"""The three questions about a learner's weights, answered by the statistics of its runs.

Where does it look? Is that where the policy goes? Does it help?
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from tom.analysis import planes, scores, statistics
from tom.analysis.curves import Curve, curve_of
from tom.analysis.exams import Exams, exams_of, last_steps, medians, ranking
from tom.analysis.grouping import has_uniform_learner
from tom.analysis.statistics import RANKED, SIGNIFICANT, Interval
from tom.analysis.weight_readers import first_weight_reader
from tom.envs import ROAD
from tom.errors import UserError
from tom.learners import learner_label
from tom.readable import percent, score, short
from tom.record.decode import Profiles
from tom.record.reader import RunReader
from tom.record.task_record import dimension_names, task_of

Floats = NDArray[np.float64]
Word = Literal["yes", "no", "unclear", "unknown"]
STANDS_OUT = 0.1
"""the least share of the log weights that a plane explains if a part of the buffer stands out"""
QUESTIONS = ("Where does it look?", "Is that where the policy goes?", "Does it help?")
ROAD_METRICS = ("weights/road_share", "weights/road_ratio")
MIDDLE = "iqm"
"""the statistic over runs in every sentence: one run far from the others hardly moves it"""
NEWEST = 0.2
"""the share of the weight on the newest fifth if every transition counts the same"""


@dataclass(frozen=True)
class Answer:
    """The answer to one question: a verdict, a sentence in Markdown, and what would tell more."""

    word: Word
    verdict: str
    sentence: str
    more: str = ""


@dataclass(frozen=True)
class Contrast:
    """The direction of (s, a, s') in which the weights of one fit differ most."""

    seed: int
    env_step: int
    loadings: Mapping[str, int]
    """the signs of its largest loadings by dimension; weight grows along it"""
    explained: float
    """the share of the log weights that the contrast plane explains (`tom.analysis.planes`)"""


def contrast(run: RunReader, step: int) -> Contrast | None:
    """That of the fit at `step`, whose weights are stored; None if its buffer is not kept."""
    weight, record = run.snapshot(step)["weight"].to_numpy(np.float64), run.buffer()[0]
    end = run.profiles().rows_at(step)
    if not 0 < len(weight) <= end <= len(record):
        return None
    rows = record[end - len(weight) : end]
    try:
        described = () if run.env == ROAD else task_of(run).obs_names
    except UserError:  # a task whose code is not here
        described = ()
    names = dimension_names(run.env, rows, described)
    plane = planes.contrast_of(rows, weight, names)
    share = planes.explained_share(planes.of_rows(plane, rows), weight)
    largest = planes.loadings(plane.axes[:, 0], planes.feature_names(*names))
    return Contrast(run.seed, step, largest, share)


@dataclass(frozen=True)
class Side:
    """A group of runs of one task that differ only in the seed; their data, in one order (n,)."""

    name: str
    env: str
    uniform: bool
    """whether its learner counts every transition the same"""
    live: bool
    """whether the weights are live ones of training loops, which do not learn from them"""
    profiles: Sequence[Profiles]
    returns: Sequence[Curve]
    metrics: Sequence[pd.DataFrame]
    exams: Sequence[Exams]
    weighs_from: float
    """the step of the fit from which on every run weighs; -infinity if none does"""
    contrast: Contrast | None
    """that of the first run that keeps its buffer"""


def side_of(
    title: str,
    loops: Sequence[RunReader],
    metrics: Callable[[RunReader], pd.DataFrame] = RunReader.metrics,
    profiles: Callable[[RunReader], Profiles] = RunReader.profiles,
    contrast: Callable[[RunReader, int], Contrast | None] = contrast,
    escaped: Callable[[str], str] = str,
) -> Side:
    """The runs of a group with this title, at least one, read by these functions.

    `escaped` makes of a name what stands in a sentence, which is Markdown.
    """
    runs = [first_weight_reader(run) for run in loops]
    live = [run for run, loop in zip(runs, loops, strict=True) if run is not loop]
    name = escaped(title + "".join(f" ({learner_label(run.learner)}, live)" for run in live[:1]))
    tables = [metrics(run) for run in runs]
    kept = (
        contrast(run, run.snapshot_steps()[-1])  # of the last kept fit
        for run in runs
        if run.snapshot_steps() and run.version("buffer") and not has_uniform_learner(run)
    )
    return Side(
        name,
        loops[0].env,
        all(map(has_uniform_learner, runs)),  # grouped by a setting, learners are mixed
        bool(live),
        [profiles(run) for run in runs],
        [curve_of(run, metrics(run), "eval/return") for run in loops],
        tables,
        [
            exams_of(run.run_id, run.learner, run.seed, name, table)
            for run, table in zip(runs, tables, strict=True)
        ],
        scores.counted_from(tables),
        next(filter(None, kept), None),
    )  # fmt: skip


def answers(one: Side, other: Side | None) -> tuple[Answer, Answer, Answer]:
    """The answers to `QUESTIONS`: of `one`, compared with `other` if there is one."""
    return where(one), on_policy(one), helps(one, other)


def newest_share(profiles: Profiles) -> Floats:
    """The share of the weight on the newest fifth of the buffer at every fit, (F,).

    A bin across the border counts in proportion. NaN where no weight is above zero.
    """
    bins = profiles.bins
    whole, part = divmod(4 * bins.shape[1], 5)
    newest = bins[:, whole:].sum(1) - bins[:, whole : whole + 1].sum(1) * part / 5
    total = bins.sum(1)
    return np.divide(newest, total, out=np.full(len(bins), np.nan), where=total > 0)


def where(side: Side) -> Answer:
    """Where the weights of the runs' last fits lie."""
    last = [profiles for profiles in side.profiles if len(profiles.env_step)]
    if side.uniform:
        return Answer(
            "unclear", "Everywhere equally", f"{side.name} counts every transition the same.",
            "Choose a learner that weighs, such as TOM or PMAC.",
        )  # fmt: skip
    if side.env == ROAD:
        return _on_road(side)
    if not last:
        return Answer(
            "unknown", "Cannot be told yet", f"{side.name} has not fitted a model yet.",
            "Weights come with the first fit.",
        )  # fmt: skip
    newest = scores.interval(np.array([newest_share(one)[-1] for one in last]), MIDDLE)
    ess = scores.interval(np.array([one.ess[-1] for one in last], np.float64), MIDDLE)
    sentence = (
        f"{side.name} puts **{percent(newest.value, 0)}** of its weight on the newest fifth of its "
        f"buffer{_interval_text(newest)}; equal weights would put 20 %. The effective sample is "
        f"{percent(ess.value, 0)} of the rows ({_count(len(last))}, last fit)."
    )
    if side.contrast is not None:
        sentence += f" {_contrast_sentence(side.contrast)}"
    if newest.low > NEWEST or (len(last) == 1 and newest.value > 1.5 * NEWEST):
        return Answer("yes", "At new data", sentence)
    if newest.high < NEWEST or (len(last) == 1 and newest.value < 0.5 * NEWEST):
        return Answer("no", "At old data", sentence)
    return Answer("unclear", "At no age in particular", sentence)


def _on_road(side: Side) -> Answer:
    """Where the runs' weights lie on road-and-rocks, whose rows have no age; by their metrics."""
    wanted = (frame.reindex(columns=list(ROAD_METRICS)) for frame in side.metrics)
    last_rows = (frame.dropna(subset=ROAD_METRICS[0])[-1:].to_numpy(np.float64) for frame in wanted)
    found = np.concatenate([np.empty((0, 2)), *last_rows])  # (runs, 2)
    if not len(found):
        return Answer("unknown", "Cannot be told yet", f"{side.name} has not fitted a model yet.")
    share = scores.interval(found[:, 0], MIDDLE)
    ratio = np.nan_to_num(found[:, 1], nan=np.inf)  # NaN: no weight on the rocks
    times = float(np.median(ratio))
    counts = (
        f"counts **{short(times)}** times as much as"
        if np.isfinite(times)
        else "counts infinitely more than"
    )
    sentence = (
        f"{side.name} puts **{percent(share.value, 0)}** of its weight on the road"
        f"{_interval_text(share)}; a random transition there {counts} one on the "
        f"rocks (median, {_count(len(found))})."
    )
    if (ratio > 1).all():
        return Answer("yes", "At the road", sentence)
    if (ratio < 1).all():
        return Answer("no", "At the rocks", sentence)
    return Answer("unclear", "At neither road nor rocks", sentence)


def _contrast_sentence(contrast: Contrast) -> str:
    """Which part of the buffer has the weight, in names of dimensions."""
    fit = f"seed {contrast.seed}, step {contrast.env_step:,}"
    if contrast.explained < STANDS_OUT:
        return f"By state and action, no part of the buffer stands out ({fit})."
    ways = " and ".join(
        f"{name} is {'higher' if sign > 0 else 'lower'}" for name, sign in contrast.loadings.items()
    )
    share = percent(contrast.explained, 0)
    return (
        f"It weighs most where {ways}. Two directions of state, action and next state explain "
        f"{share} of the variance of the log weight ({fit})."
    )


def on_policy(side: Side) -> Answer:
    """Whether the weights bring the buffer nearer to what the policy does next."""
    if side.env == ROAD:
        return Answer(
            "unknown", "Not asked here",
            "Road-and-rocks learns from a fixed data set: nothing is collected after a fit. "
            "Attention shows the weights on the map.",
        )  # fmt: skip
    if side.uniform:
        return Answer(
            "unclear", "It does not choose", f"{side.name} weighs every transition the same, so "
            "its buffer comes no nearer to the policy: a footprint of 1.",
        )  # fmt: skip
    # The median over a run's fits that weigh and whose footprint says something.
    footprints = [
        one.footprint[one.informative & (one.step >= side.weighs_from)] for one in side.exams
    ]
    measured = medians(footprints)
    if not len(measured):
        return Answer(
            "unknown", "Cannot be told yet",
            f"No fit of {side.name} has a footprint that says anything yet.",
            "A footprint compares the buffer with the steps that the policy takes after a fit. "
            "They must differ from the buffer by more than from each other: train on.",
        )  # fmt: skip
    footprint = scores.interval(measured, MIDDLE)
    left = percent(footprint.value, 0)
    sentence = (
        f"Weighted by {side.name}, the buffer keeps **{left}** of its distance to what the "
        f"policy does next{_interval_text(footprint, len(measured))}; 100 % means no nearer than "
        "without weights, 0 % the policy itself."
    )
    if len(measured) < RANKED:
        word = f"Cannot be told yet: {len(measured)} of {RANKED} runs"
        return Answer("unknown", word, sentence, "Of fewer, chance often puts all on one side.")
    if footprint.high < 1:
        return Answer("yes", "Yes, nearer to the policy", sentence)
    if footprint.low > 1:
        return Answer("no", "No, farther from the policy", sentence)
    return Answer("unclear", "Not clearly", sentence)


def helps(one: Side, other: Side | None) -> Answer:
    """Whether runs of `one` return more, and err less where their policy goes, than of `other`."""
    if one.live:
        return Answer(
            "unknown", "Not asked here", "Live weights are computed alongside a training loop, "
            "which does not learn from them.", "`run.latest_weights()` would give them to it.",
        )  # fmt: skip
    if other is None:
        return Answer(
            "unknown", "Cannot be told yet", "There is nothing to compare it with.",
            "Train MLE, which weighs every row the same.",
        )  # fmt: skip
    error = _error_sentence(one, other)
    pairs = [[c for c in side.returns if len(c.step)] for side in (one, other)]
    if not all(pairs):
        empty = one if not pairs[0] else other
        return Answer(
            "unknown", "Cannot be told yet", f"{empty.name} has not been evaluated yet. {error}"
        )  # fmt: skip
    # The step that enough seeds of each reach, so that a run that has just begun changes nothing.
    last = [last_steps((c.seed, float(c.step[-1])) for c in curves) for curves in pairs]
    until = min(steps[-min(RANKED, len(steps))] for steps in last)
    comparable = [
        [curve for curve in curves if curve.step[0] <= until <= curve.step[-1]] for curves in pairs
    ]
    if not all(comparable):
        return Answer(
            "unknown", "Cannot be told yet", f"The runs have no step in common yet. {error}"
        )
    since = scores.common_start(curve for curves in comparable for curve in curves)
    final, *others = (
        [scores.scores_of(curves, name, until, since) for curves in comparable]
        for name in (scores.FINAL, scores.BEST, scores.HEIGHT)
    )
    middle = [score(scores.interval(values, MIDDLE).value) for values in final]
    counts = f"{len(final[0])} and {len(final[1])} runs"
    at = f"at step {until:,.0f}"
    fewest = min(len({c.seed for c in curves}) for curves in comparable)
    if fewest < RANKED:
        return Answer(
            "unknown", f"Cannot be told yet: {fewest} of {RANKED} seeds",
            f"{at.capitalize()}, {one.name} returns {middle[0]} and {other.name} {middle[1]} "
            f"(interquartile means of {counts}). {error}",
            f"{RANKED} seeds of each are needed.",
        )  # fmt: skip
    beats = statistics.probability_of_improvement(final[:1], final[1:])
    ps = [statistics.exchangeable(of[:1], of[1:]) for of in (final, *others)]
    p, of_all = ps[0], statistics.corrected(ps)[0]
    chance = f"{10 * beats.value:.0f} times in 10 (p {p:.2g})"
    sentence = (
        f"{at.capitalize()}, {one.name} returns **{middle[0]}** and {other.name} **{middle[1]}** "
        f"(interquartile means of {counts}); a random run of {one.name} beats one of {other.name} "
        f"{chance}. {error}"
    ).rstrip()
    if p >= SIGNIFICANT:
        return Answer("unclear", "Not clearly", sentence)
    comes_out = "more" if beats.value > 0.5 else "less"
    corrected = f"Corrected for the three scores in Curves, Statistics, p is {of_all:.2g}."
    if of_all >= SIGNIFICANT:
        return Answer("unclear", f"Perhaps it returns {comes_out}", sentence, corrected)
    if beats.value > 0.5:
        return Answer("yes", "Yes, it returns more", sentence, corrected)
    return Answer("no", "No, it returns less", sentence, corrected)


def _error_sentence(one: Side, other: Side) -> str:
    """A sentence on the models' errors in the exams; empty without exams of both."""
    result = ranking([*one.exams, *other.exams], max(one.weighs_from, other.weighs_from))
    typical = {standing.name: standing for standing in result.standings}
    first, second = typical.get(one.name), typical.get(other.name)
    if first is None or second is None or not (len(first.error) and len(second.error)):
        return ""
    numbers = (
        f"{short(first.typical)} against {short(second.typical)} standard deviations of a step's "
        "change"
    )
    if not result.ranked:
        return f"Where their policies go, the models err by {numbers}, one step ahead."
    p = statistics.exchangeable([first.error], [second.error])
    less = "less" if first.typical < second.typical else "more"
    if p >= SIGNIFICANT:
        return f"Neither model is clearly better where its policy goes: {numbers} (p {p:.2g})."
    return f"Its model errs {less} where its policy goes: {numbers} (p {p:.2g})."


def _interval_text(interval: Interval, n: int = 0) -> str:
    """The interval, and the number of runs unless it is said elsewhere, in brackets."""
    parts = [_count(n)] if n else []
    if np.isfinite(interval.low):
        ends = percent(interval.low, 0), percent(interval.high, 0)
        parts.insert(0, f"95 % interval {' to '.join(ends)}")
    return f" ({', '.join(parts)})" if parts else ""


def _count(n: int) -> str:
    return "1 run" if n == 1 else f"{n} runs"
