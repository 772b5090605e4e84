"""The current state of one of the watched runs: its weight map and newest evaluation in 3D."""

from collections.abc import Mapping, Sequence

import streamlit as st

from app import session
from app.data import readers, road
from app.figures.base import steps_in_words
from app.figures.weights import weight_map
from app.parts import empty, pick, widgets
from app.parts.plot import chart
from app.parts.stage import stage
from app.scenes.control import Choice, ReplayChoice, RoadChoice
from tom.config import SAC_ALONE
from tom.envs import ROAD
from tom.record.reader import RunReader

HEIGHT = 330
NO_MODEL = "SAC alone fits no model, so there are no weights: Probe weighs its buffer."
WITHOUT_GHOST = 0
"""no ghost, because the run's model would be read again after each checkpoint"""
SEEN = "live evaluation"
"""the evaluation on the stage, and a count of them, so that each new one is played"""


def pick_followed(runs: Sequence[RunReader], called: Mapping[str, str]) -> RunReader:
    """The run whose weights and robot are shown; training runs with uneven weights come first.

    `called` are the runs' names by id.
    """
    by_id = {run.run_id: run for run in runs}
    alive = [run for run in runs if run.status.alive]
    first = widgets.most_telling(alive or runs)
    offered = {run_id: called[run_id] for run_id in by_id}
    return by_id[pick.one("Weights and robot of", offered, first.run_id, "follow")]


def weights(run: RunReader) -> None:
    """The weight of each part of the buffer at every fit so far."""
    profiles = readers.profiles(run)
    if not len(profiles.env_step):
        st.caption(without_weights([run]))
        return
    last = len(profiles.env_step) - 1
    x = steps_in_words([run.env])
    figure = weight_map(profiles, last, session.mode(), HEIGHT, relative=True, x=x, keep=run.run_id)
    chart(figure, "live map", "weight of each part of the buffer at every fit")


def without_weights(runs: Sequence[RunReader]) -> str:
    """Why none of the runs has weights to show."""
    alone = all(run.learner == SAC_ALONE for run in runs)
    return NO_MODEL if alone else "No fit yet: weights come with the first."


def robot(run: RunReader) -> None:
    """The newest evaluation, played once; for road-and-rocks its newest map."""
    choice = _newest(run)
    if choice is None:
        if not empty.left_out(run, empty.EVALUATIONS):
            st.caption("No evaluation yet: the robot comes with the first.")
        return
    stage(choice, HEIGHT, "live", compact=True)


def newest_step(run: RunReader) -> int | None:
    """The step that `robot` shows."""
    if run.env == ROAD:
        return next(iter(road.steps(run)[-1:]), None)
    return next(iter(run.evaluation_steps()[-1:]), None)


def _newest(run: RunReader) -> Choice | None:
    step = newest_step(run)
    if step is None:
        return None
    if run.env == ROAD:
        return RoadChoice((run.run_id,), step)
    shown, count = st.session_state.get(SEEN, (None, 0))
    if shown != (run.run_id, step):
        count += 1
        st.session_state[SEEN] = ((run.run_id, step), count)
    return ReplayChoice(run.run_id, step, 0, 0, WITHOUT_GHOST, count, "start")
