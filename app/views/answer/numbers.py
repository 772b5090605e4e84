"""The numbers behind the cards: exams of the runs' fits, and their models' errors in sample."""

from collections import Counter
from collections.abc import Callable, Mapping, Sequence

import numpy as np
import pandas as pd
import streamlit as st

from app import text
from app.data import buffer, readers
from app.data.buffer import Floats
from app.data.cache import get_or_make
from app.data.run_names import distinct_names
from app.figures.exams import errors_by_age, footprint_error_return
from app.parts import widgets
from app.parts.plot import chart
from app.parts.scope import Scope
from tom.analysis import statistics
from tom.analysis.exams import Exams, Ranking, Standing, exams_of, ranking
from tom.analysis.scores import counted_from, interval
from tom.readable import UNKNOWN, percent, short
from tom.record.reader import RunReader

HEIGHT = 380
MODELS, BINS = 8, 20
"""stored models that are tested on one buffer, and parts of it whose mean errors are drawn"""
NO_EXAM = "no exam: recorded by a version before exams, or still on the first fit"
WHAT = (
    "A fit's exam is the real steps that its policy takes until the next fit; its buffer holds "
    "none of them. Errors are root mean squares over the state's dimensions, each in standard "
    "deviations of its change in a step. A run's number is the median over its fits, from the "
    "step at which every run weighs."
)
OWN = (
    "Each run is examined on what its own policy encountered, in units of its own buffer, so "
    "learners also differ in policy and data. `tom reproduce footprint` and `tom reproduce "
    "capacity` compare them on the same buffers."
)
LENGTHS = 2.0
"""a run is like the others if it has between half and twice their median number of steps"""
FEW_NAMED = 8
"""runs that are named in a line, not in its help"""
COLUMNS = {
    "one step": st.column_config.Column(
        "error, one step", help="interquartile mean over runs, 95 % bootstrap interval"
    ),
    "five steps": st.column_config.Column(
        "error, five steps", help="five modelled steps under the recorded actions"
    ),
    "footprint": st.column_config.Column(
        help="1: no nearer than without weights, 0: the policy itself"
    ),
    "fits that count": st.column_config.Column(
        help="fits whose footprint stands out from its noise"
    ),
}


def draw(scope: Scope, env: str) -> None:
    """The exams of all runs of a task, and their models' errors on one buffer and on their own."""
    runs = [run for run in scope.runs if run.env == env and run.fits_model]
    alike, others = split_by_length(runs)
    _list_left_out(runs, {"of another length": others})
    _exams(scope, alike)
    st.subheader("In sample: on rows that the models were fitted to", anchor=False)
    st.caption(
        "A model can err little here and yet much where its policy goes next; only the exams above "
        "are out of sample. Curves has what each run measured on its own buffer, as model/error_*."
    )
    run = scope.choose_run(lambda run: run in alike and buffer.has_rows(run), widgets.interest_key)
    if run is not None:
        _on_one_buffer(scope, run, alike)


def _exams(scope: Scope, runs: Sequence[RunReader]) -> None:
    """Who errs least on its own policy's transitions, the numbers, and a figure of all fits."""

    def make() -> tuple[list[Exams], Ranking]:
        read = [
            exams_of(run.run_id, run.learner, run.seed, scope.title(run), readers.metrics(run))
            for run in sorted(runs, key=lambda run: (run.learner, run.seed, run.run_id))
        ]
        exams = [one for one in read if len(one.step)]
        return exams, ranking(exams, counted_from(map(readers.metrics, runs)))

    key = "exams", *((run.path, scope.title(run)) for run in runs)
    exams, result = get_or_make(key, tuple(map(readers.metrics_version, runs)), make)
    too_short = {one.run_id: result.ended_before(one) for one in exams}
    without = [run for run in runs if run.run_id not in too_short]
    early = [run for run in runs if too_short.get(run.run_id)]
    _list_left_out(runs, {NO_EXAM: without, f"ended before step {result.until:,.0f}": early})
    if not exams:
        return
    st.markdown(text.with_glossary_links(text.unbroken(verdict(result))), help=WHAT)
    st.dataframe(table(result), hide_index=True, column_config=COLUMNS, alt="The exams")
    with st.container(border=True):
        st.markdown(
            "**Where the weights lie, how the model errs, what came of it**: each point is a fit, "
            "at the same height in both panels",
            help="A footprint is the energy distance between the weighted buffer and the exam, "
            "divided by that of the unweighted buffer. It says nothing if the unweighted buffer "
            "is no farther from the exam than the exam's two halves are from each other.",
        )
        figure = footprint_error_return(exams, HEIGHT)
        chart(figure, "exams", "footprint, error in the exam and next return of every fit")
    few = statistics.remark(min(one.seeds for one in result.ranked or result.standings))
    st.caption(f"{text.markdown(few)}. {OWN}" if few else OWN)


def verdict(result: Ranking) -> str:
    """One sentence: who errs least on its policy's transitions, by how much, and if it is noise."""
    until = f" to step {result.until:,.0f}" if np.isfinite(result.until) else ""
    counted = f" up{until}" if until else ""  # the steps whose fits count; empty if all do
    if np.isfinite(result.since):
        counted = f" from step {result.since:,.0f}{until or ' on'}"
    if not result.ranked:
        return (
            f"**Too few seeds to rank** (two learners with {statistics.RANKED} seeds each are "
            f"needed). The table has the errors where the policy goes, in the exams{counted}."
        )
    first, second = result.ranked[:2]
    beats, p = result.first_beats_second, result.p_value
    one, other = (text.markdown(standing.name) for standing in (first, second))
    errors = (
        f"{short(first.typical)}, {percent(1 - first.typical / second.typical, 0)} less than "
        f"the next, {other}, with {short(second.typical)},{counted} "
        f"(n: {_runs(first)}; {_runs(second)})"
    )
    chance = (
        f"a run of {one} errs less than one of {other} with probability {beats.value:.2f} "
        f"(95 % interval {beats.low:.2f} to {beats.high:.2f}; p {p:.2g} by permutation)"
    )
    where = "**Where its own policy goes, "
    if p < statistics.SIGNIFICANT:
        return f"{where}{one} errs least**: {errors}. More than noise: {chance}."
    return f"{where}no learner errs clearly less**: {one} has the least, {errors}, but {chance}."


def _runs(one: Standing) -> str:
    runs = "1 run" if len(one.error) == 1 else f"{len(one.error)} runs"
    return f"{runs}, 1 fit" if one.fits == 1 else f"{runs}, {one.fits:,} fits"


def table(result: Ranking) -> pd.DataFrame:
    """One row per group: n, and interquartile means over its runs with 95 % bootstrap intervals."""

    def mean(values: Floats) -> str:
        found = interval(values, "iqm")
        return str(found) if np.isfinite(found.value) else UNKNOWN

    return pd.DataFrame(
        {
            "group": one.name,
            "runs": len(one.error),
            "seeds": one.seeds,
            "fits": one.fits,
            "one step": mean(one.error),
            "five steps": mean(one.rollout_error),
            "footprint": mean(one.footprint),
            "fits that count": one.informative_fits,
        }
        for one in result.standings
    )


def _on_one_buffer(scope: Scope, run: RunReader, others: Sequence[RunReader]) -> None:
    """The errors on the buffer of `run` of its own stored model and of other runs' models."""
    kept = [other for other in others if buffer.has_model(other)]
    errors, beyond = [], list(kept)
    for other in alternating_groups(run, kept, scope.title):
        error = buffer.errors_on(run, other)
        if error is not None:
            own = " (its own)" if other.run_id == run.run_id else ""
            errors.append((f"{scope.title(other)} s{other.seed}{own}", other.learner, error))
            beyond.remove(other)
        if len(errors) == MODELS:
            break
    if not errors:
        if not widgets.show_left_out_of_all(others, "model"):
            st.caption("No run of this task has kept a model whose errors could be shown.")
        return
    with st.container(border=True):
        st.markdown(
            "**Error of the kept models along this buffer**: one step, mean of each twentieth",
            help="root mean square over the dimensions, each in standard deviations of its change "
            "in a step over this buffer. Each model was fitted to its own buffer only.",
        )
        figure = errors_by_age(errors, BINS, 320, keep=run.run_id)
        chart(figure, "errors here", "model error against age")
        without = [other for other in others if other not in kept]
        _list_left_out(
            others,
            {"no kept model": without, f"beyond the first {MODELS} models, or unreadable": beyond},
        )


def alternating_groups(
    run: RunReader, others: Sequence[RunReader], title: Callable[[RunReader], str]
) -> list[RunReader]:
    """The run itself, then the first run of each group, then their second runs, and so on."""
    seen, turns = Counter[str](), {}
    for other in others:
        turns[other.run_id] = other.run_id != run.run_id, seen[title(other)]
        seen[title(other)] += 1
    return sorted(others, key=lambda other: turns[other.run_id])


def split_by_length(runs: Sequence[RunReader]) -> tuple[list[RunReader], list[RunReader]]:
    """The runs of about the usual length, and the others."""
    usual = float(np.median([run.status.env_step for run in runs] or [0]))

    def is_like(run: RunReader) -> bool:
        return usual / LENGTHS <= run.status.env_step <= usual * LENGTHS

    return [run for run in runs if is_like(run)], [run for run in runs if not is_like(run)]


def _list_left_out(runs: Sequence[RunReader], left_out: Mapping[str, Sequence[RunReader]]) -> None:
    """Name the runs that are left out of `runs`, a line for each reason."""
    names = distinct_names(runs, by_user=True)
    for reason, of in left_out.items():
        if of:
            steps = (f"{names[run.run_id]} ({run.status.env_step:,} steps)" for run in of)
            named = text.markdown("; ".join(steps))
            if len(of) <= FEW_NAMED:
                st.caption(f"Left out ({reason}): {named}.")
            else:
                st.caption(f"Left out ({reason}): {len(of)} runs.", help=named)
