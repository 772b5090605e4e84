"""Small parts that several pages are made of."""

from collections.abc import Sequence

import numpy as np
import streamlit as st
from numpy.typing import NDArray
from streamlit.delta_generator import DeltaGenerator

from app import text
from app.data import readers
from app.data.aggregate import Curve, curve_points
from app.data.readers import RunInfo
from app.parts import asked
from tom.learners import LEARNERS


def curve(run: RunInfo, metric: str) -> Curve:
    """One metric of a run against env steps."""
    step, value = curve_points(readers.metrics(run), metric)
    return Curve(run.run_id, run.env, run.learner, run.preset, run.seed, step, value)


TOWERS = 20.0
"""times uniform: on a linear axis with this, one sees next to nothing of the others"""


def pick_run(runs: Sequence[RunInfo], label: str = "Run") -> RunInfo:
    """A run, chosen here or by the address (`?run=...`); else the most telling one."""
    by_id = {run.run_id: run for run in runs}
    asked.tell("run", by_id)
    first = most_telling(runs)
    chosen = st.selectbox(
        label,
        list(by_id),
        index=list(by_id).index(first.run_id),
        key="run",
        bind="query-params",
        on_change=asked.answered,
        args=("run",),
    )
    return by_id.get(chosen or "", first)


def most_telling(runs: Sequence[RunInfo]) -> RunInfo:
    """The newest whose weights differ; of small copies, which nobody made just now, TOM's longest.

    Small copies come after one's own runs; of equally long ones the one that left out least.
    """
    order = sorted(runs, key=_rank)
    return next((run for run in order if differs(run)), order[0])


def _rank(run: RunInfo) -> tuple[bool, bool, int, int]:
    if not run.small_copy:
        return False, False, 0, 0  # as they come: the newest first
    return True, run.learner != "tom", -run.status.env_step, len(run.left_out)


def differs(run: RunInfo) -> bool:
    """The last fit of a run did not count all transitions the same."""
    if run.learner in LEARNERS and LEARNERS[run.learner].uniform:
        return False  # no need to look
    profiles = readers.profiles(run)
    return len(profiles.ess) > 0 and bool(profiles.ess[-1] < 0.99)


def pick_log(place: DeltaGenerator, profiles: Sequence[NDArray[np.float64]]) -> bool:
    """Whether weights are on a log axis; until it is said here, where one towers over the rest."""
    tall = any(bins.size and bins.max() > TOWERS for bins in profiles)
    return place.toggle("Log axis", value=tall, key="log", bind="query-params")


def pick_step(label: str, steps: Sequence[int]) -> int:
    """A recorded step, chosen here, by a click or by the address (`?step=...`); else the last.

    Who stands on the last of a run in training stays on the last when there are more.
    """
    if len(steps) == 1:
        return steps[0]
    last = steps[-1]
    step = st.session_state.get("step", last)
    if step not in steps:
        del st.session_state["step"]  # it was chosen for another run
    elif step != last and step == st.session_state.get("step was last"):
        st.session_state["step"] = last
    st.session_state["step was last"] = last
    step = st.select_slider(
        label, steps, value=last, key="step", bind="query-params", format_func=str
    )
    return int(step)


def show_problems(run: RunInfo, problems: Sequence[str] | None = None) -> None:
    """What is damaged in a run, beside what could be read of it."""
    for problem in readers.problems(run) if problems is None else problems:
        st.warning(
            f"{text.markdown(run.run_id)}: {text.markdown(problem)}", icon=":material/heart_broken:"
        )


def show_store_problems(problems: Sequence[str]) -> None:
    """What in the store is no run, folded away."""
    if problems:
        with st.expander(f"{len(problems)} in this store could not be read as a run"):
            for problem in problems:
                st.text(problem)
