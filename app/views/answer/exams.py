"""Whether weighting helps out of sample: the results of the exams of the runs' fits."""

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
import streamlit as st

from app import glossary, text
from app.data import readers
from app.data.cache import VersionedCache
from app.data.called import short_names
from app.data.exams import Exams, Ranking, Standing, exams_of, middle, ranking
from app.figures.curves import looks_of
from app.figures.exams import footprint_error_return
from app.parts.plot import chart
from tom.analysis import statistics
from tom.analysis.scores import counted_from
from tom.analysis.settings import kinds_of
from tom.analysis.statistics import Interval
from tom.readable import UNKNOWN, percent, short
from tom.record.reader import RunReader

HEIGHT = 380
SIGNIFICANT = 0.05
"""the p below which a difference of two learners is called more than noise"""
NO_EXAM = "no exam (of a version before exams, or its first fit still serves)"
WHAT = (
    "The exam of a fit: the real steps that its policy went on to make until the next fit. They "
    "are not in its buffer. Errors are root mean squares over the dimensions of the state, each in "
    "standard deviations of its change in a step; of a run the median over its fits counts, from "
    "the step on from which every run weighs."
)
OWN = (
    "Each run is examined on what its own policy met, in units of its own buffer, so learners "
    "differ in policy and data too; `tom reproduce footprint` and `tom reproduce capacity` compare "
    "them on the same buffers."
)
LENGTHS = 2.0
"""a run is like the others if it has between half and twice their median number of steps"""
FEW_NAMED = 8
"""runs that are named in a line; more are named in its help"""
NAMED = 3
"""groups that a sentence names at most"""
NEEDED = f"two learners with {statistics.RANKED} seeds each are needed"
_RANKINGS: VersionedCache[tuple[list[Exams], Ranking]] = VersionedCache()


def draw(runs: Sequence[RunReader]) -> None:
    """Who errs least on its own policy's transitions, the numbers, and a figure of all fits."""
    exams, result = examined(runs)
    sat = {one.run_id: result.ended_before(one) for one in exams}
    without = [run for run in runs if run.run_id not in sat]
    early = [run for run in runs if sat.get(run.run_id)]
    show_left_out(runs, {NO_EXAM: without, f"ended before step {result.until:,.0f}": early})
    if not exams:
        return
    st.markdown(glossary.linked(verdict(result)), help=WHAT)
    st.dataframe(table(result), hide_index=True, column_config=_columns())
    with st.container(border=True):
        st.markdown(
            "**Where the weights lie, how the model errs, what came of it**: a point is a fit, at "
            "one height in both panels",
            help="A footprint is the energy distance between the weighted buffer and the exam, "
            "over that of the buffer without weights. It says nothing where that buffer lies no "
            "farther from the exam than two halves of the exam from each other.",
        )
        figure = footprint_error_return(exams, HEIGHT)
        chart(figure, "exams", "footprint, error in the exam and next return of every fit")
    few = statistics.remark(min(one.seeds for one in result.ranked or result.standings))
    st.caption(f"{text.markdown(few)}. {OWN}" if few else OWN)


def examined(runs: Sequence[RunReader]) -> tuple[list[Exams], Ranking]:
    """The exams of the runs that have any, and their ranking."""

    def make() -> tuple[list[Exams], Ranking]:
        names = group_names(runs)
        read = [
            exams_of(run.run_id, run.learner, run.seed, names[run.run_id], readers.metrics(run))
            for run in sorted(runs, key=lambda run: (run.learner, run.seed, run.run_id))
        ]
        exams = [one for one in read if len(one.step)]
        return exams, ranking(exams, counted_from(map(readers.metrics, runs)))

    version = tuple((run.path, run.version("metrics")) for run in runs)
    return _RANKINGS.get(tuple(run.path for run in runs), make, version)


def group_names(runs: Sequence[RunReader]) -> dict[str, str]:
    """By run id the name of its group: its learner, and what distinguishes it from other groups."""
    kinds = kinds_of(runs)
    groups = looks_of((run.env, kinds[run.run_id]) for run in runs)
    return {run_id: groups[kind].title for run_id, kind in kinds.items()}


def verdict(result: Ranking) -> str:
    """One sentence: who errs least on its policy's transitions, by how much, and if it is noise."""
    if not result.ranked:
        counts = "; ".join(
            f"{text.markdown(one.name)}: {_runs(one)}, typical error {short(one.typical)}"
            for one in result.standings
        )
        if len(result.standings) > NAMED:
            counts = f"the errors of {len(result.standings)} groups stand in the table below"
        return (
            f"**Too few seeds to rank** ({NEEDED}). "
            f"Where the policy goes, one step ahead in the exams{counted(result)}: {counts}."
        )
    first, second = result.ranked[:2]
    beats, p = result.first_beats_second, result.chance
    one, other = (text.markdown(standing.name) for standing in (first, second))
    less = 1 - first.typical / second.typical
    errors = (
        f"{short(first.typical)}, {percent(less, 0)} less than {other}, the next, "
        f"with {short(second.typical)},{counted(result)} "
        f"(n: {_runs(first)}; {_runs(second)})"
    )
    chance = (
        f"a run of {one} errs less than one of {other} with probability {beats.value:.2f} "
        f"(95 % interval {beats.low:.2f} to {beats.high:.2f}; p {p:.2g} by permutation)"
    )
    if p < SIGNIFICANT:
        return (
            f"**Where its own policy goes, {one} errs least**: {errors}. More than noise: {chance}."
        )
    return (
        f"**Where its own policy goes, nobody errs less beyond noise**: least is {one} with "
        f"{errors}, but {chance}."
    )


def counted(result: Ranking) -> str:
    """The steps whose fits count, in words; empty if all do."""
    since, until = f"{result.since:,.0f}", f"{result.until:,.0f}"
    if not np.isfinite(result.since):
        return f" up to step {until}" if np.isfinite(result.until) else ""
    return f" from step {since} " + (f"to {until}" if np.isfinite(result.until) else "on")


def _runs(one: Standing) -> str:
    runs = "1 run" if len(one.error) == 1 else f"{len(one.error)} runs"
    return f"{runs}, 1 fit" if one.fits == 1 else f"{runs}, {one.fits:,} fits"


def table(result: Ranking) -> pd.DataFrame:
    """One row per group: n, and interquartile means over its runs with 95 % bootstrap intervals."""
    rows = []
    for one in result.standings:
        rows.append(
            {
                "group": one.name,
                "runs": len(one.error),
                "seeds": one.seeds,
                "fits": one.fits,
                "one step": _words(middle(one.error)),
                "five steps": _words(middle(one.rollout_error)),
                "footprint": _words(middle(one.footprint)),
                "fits that count": one.telling,
            }
        )
    return pd.DataFrame(rows)


def _words(mean: Interval) -> str:
    return str(mean) if np.isfinite(mean.value) else UNKNOWN


def _columns() -> dict:
    column = st.column_config.Column
    return {
        "one step": column(
            "error, one step", help="interquartile mean over runs, 95 % bootstrap interval"
        ),
        "five steps": column(
            "error, five steps", help="five modelled steps under the recorded actions"
        ),
        "footprint": column(help="1: no better than no weights, 0: like the policy itself"),
        "fits that count": column(help="fits whose footprint is not lost in its noise"),
    }


def of_like_length(runs: Sequence[RunReader]) -> tuple[list[RunReader], list[RunReader]]:
    """The runs of about the usual length, and the others."""
    if not runs:
        return [], []
    usual = float(np.median([run.status.env_step for run in runs]))
    like = [usual / LENGTHS <= run.status.env_step <= usual * LENGTHS for run in runs]
    kept = [run for run, is_like in zip(runs, like, strict=True) if is_like]
    return kept, [run for run, is_like in zip(runs, like, strict=True) if not is_like]


def show_left_out(runs: Sequence[RunReader], left_out: Mapping[str, Sequence[RunReader]]) -> None:
    """Name the runs that are left out of `runs`, a line for each reason."""
    called = short_names(runs)
    for reason, of in left_out.items():
        if of:
            named = text.markdown("; ".join(called[run.run_id] for run in of))
            if len(of) <= FEW_NAMED:
                st.caption(f"Left out, {reason}: {named}.")
            else:
                st.caption(f"Left out, {reason}: {len(of)} runs.", help=named)
