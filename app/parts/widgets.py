"""Small widgets that several pages use."""

from collections.abc import Sequence

import numpy as np
import streamlit as st
from numpy.typing import NDArray
from streamlit.delta_generator import DeltaGenerator

from app import text
from app.data import readers
from app.data.called import names
from app.parts import pick
from tom.analysis.curves import Curve, curve_points
from tom.learners import LEARNERS, SUBJECT
from tom.record.reader import RunReader


def curve(run: RunReader, metric: str) -> Curve:
    """One metric of a run against env steps."""
    step, value = curve_points(readers.metrics(run), metric)
    return Curve(run.run_id, run.env, run.learner, run.preset, run.seed, step, value)


TOWERS = 20.0
"""a weight (relative to uniform) that makes the others invisible on a linear axis"""


def pick_run(
    runs: Sequence[RunReader], label: str = "Run", likely: Sequence[RunReader] = ()
) -> RunReader:
    """A run, chosen by the user or the address (`?run=`), else the `most_telling` of `likely`."""
    by_id = {run.run_id: run for run in runs}
    return by_id[pick.one(label, names(runs), most_telling(likely or runs).run_id, "run")]


def most_telling(runs: Sequence[RunReader]) -> RunReader:
    """The default run: the newest with non-uniform weights; of small copies TOM's longest.

    Small copies come after other runs; of equally long ones the most complete comes first.
    """
    order = sorted(runs, key=_rank)
    return next((run for run in order if differs(run)), order[0])


def _rank(run: RunReader) -> tuple[bool, bool, int, int]:
    if not run.small_copy:
        return False, False, 0, 0  # equal rank keeps the order: newest first
    return True, run.learner != SUBJECT, -run.status.env_step, len(run.left_out)


def differs(run: RunReader) -> bool:
    """Whether the weights of the run's last fit are not uniform."""
    if run.learner in LEARNERS and LEARNERS[run.learner].uniform:
        return False  # known without reading
    profiles = readers.profiles(run)
    return len(profiles.ess) > 0 and bool(profiles.ess[-1] < 0.99)


def pick_log(place: DeltaGenerator, profiles: Sequence[NDArray[np.float64]]) -> bool:
    """Whether weights are on a log axis; the default is true if one weight dominates."""
    tall = any(bins.size and bins.max() > TOWERS for bins in profiles)
    return place.toggle("Log axis", value=tall, key="log", bind="query-params")


def show_problems(run: RunReader, problems: Sequence[str] | None = None) -> None:
    """Show the problems of a run."""
    for problem in readers.problems(run) if problems is None else problems:
        st.warning(
            f"{text.markdown(run.run_id)}: {text.markdown(problem)}", icon=":material/heart_broken:"
        )


def show_store_problems(problems: Sequence[str]) -> None:
    """Show the folders of the store that are not runs, folded."""
    if problems:
        with st.expander(f"{len(problems)} in this store could not be read as a run"):
            for problem in problems:
                st.text(problem)
