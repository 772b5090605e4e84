"""One evaluation episode in 3D, with the prediction of the run's model."""

import numpy as np
import streamlit as st

from app import glossary, text
from app.data import readers, replays
from app.data.called import names
from app.data.replays import DEFAULT_HORIZON, HORIZONS, Replay
from app.figures.replay import error_curve, observed_curves, return_curve, reward_curve
from app.parts import address, again, empty, player, rerun, timeline, widgets
from app.parts.plot import Point, chart
from app.parts.scope import Scope
from app.parts.stage import stage
from app.scenes.control import ReplayChoice
from app.theme import learner_label
from tom import readable
from tom.envs import ROAD
from tom.errors import UserError
from tom.record.reader import RunReader, at_or_before

VISER, RERUN = "3D scene", "Rerun"
STAGE_HEIGHT = 520
CURVE_HEIGHT = 150
"""of one dimension's curves"""
TICK_S, LISTEN_S = 0.5, 4
"""how often the page asks the scene for its clock: while it plays, and otherwise"""
CHOSEN = "another episode was chosen"


def draw(scope: Scope) -> None:
    """A run, an evaluation, an episode; the robot, its return and its reward."""
    run = scope.one(lambda run: bool(run.evaluation_steps()), widgets.telling)
    empty.of_own_loop(scope, run, "evaluations")
    if run is None:
        if not empty.left_out_of_all(scope.runs, empty.EVALUATIONS):
            st.info("No run here has been evaluated yet: its episodes are recorded then.")
        return
    steps = run.evaluation_steps()
    asked = timeline.chosen(sorted({*readers.profiles(run).env_step.tolist(), *steps}))
    step = at_or_before(steps, asked)
    timeline.draw(readers.profiles(run).env_step.tolist(), steps, asked)
    returns = readers.returns(run, step)
    if not len(returns):
        st.warning("The episodes of this evaluation cannot be read.")
        return
    called = text.markdown(names(scope.runs)[run.run_id])
    top = st.columns([6, 3, 3], vertical_alignment="bottom")
    top[0].header(f"{called}, evaluated at step {step:,}", anchor=False)
    options = list(range(1, len(returns) + 1))
    label = f"Episode (of {len(returns)})"
    index = address.choose_one(top[1].selectbox, label, options, "episode", 1) - 1
    horizon = address.choose_one(
        top[2].selectbox, "Ghost starts again every", HORIZONS, "ghost", DEFAULT_HORIZON,
        lambda n: "whole episode" if n == HORIZONS[-1] else f"{n} step{'s' * (n > 1)}",
    )  # fmt: skip
    replay = _loaded(run, step, index, horizon)
    if replay is None:
        return
    _numbers(replay)
    _link_to_buffer(run, step)
    _, moves = player.position()
    play = st.fragment(_play, run_every=TICK_S if moves else None)
    play(run, replay, returns, index, horizon, moves=moves)
    if not moves:
        again.when_changed(player.position, LISTEN_S)
    empty.left_out(run, "other evaluations", "other episodes")
    widgets.show_problems(run)


def _link_to_buffer(run: RunReader, step: int) -> None:
    """A link to the episode of the buffer that was collected before the evaluation at `step`."""
    kept = [fit for fit in run.snapshot_steps() if fit <= step]
    if kept and run.env != ROAD:
        label = f"The buffer's newest episode at step {kept[-1]:,}, on its map"
        where = {"run": run.run_id, "step": str(kept[-1])}
        widgets.link_to("attention", label, row=str(kept[-1] - 1), **where)


def _loaded(run: RunReader, step: int, index: int, horizon: int) -> Replay | None:
    """The chosen episode; None, and why in one line, if it cannot be shown."""
    try:
        replay = replays.load(run, step, index, horizon)
    except UserError as error:
        st.warning(text.markdown(error))
        return None
    if replay is None:
        st.warning("This episode cannot be read.")
    return replay


def _play(
    run: RunReader, replay: Replay, returns: np.ndarray, index: int, horizon: int, *, moves: bool
) -> None:
    """The episode and its charts, which follow the clock of the scene during playback."""
    if st.session_state.pop(CHOSEN, False) or player.position()[1] != moves:
        st.rerun()  # the choice of a click here is read above, and so is whether to follow
    playing = player.follow(replay)
    frame = player.marked(replay)
    left, right = st.columns([3, 2])
    with left:
        viewer = address.choose_one(
            st.segmented_control, "Viewer", [VISER, RERUN], "viewer", VISER, required=True,
            label_visibility="collapsed",
        )  # fmt: skip
        if viewer == RERUN:
            name = f"episode-{replay.step}-{index}-{horizon}.rrd"
            rerun.show(run.run_id, [name], STAGE_HEIGHT)
        else:
            shown = player.choice(run.run_id, replay, index, horizon)
            _scene(replay, frame, shown, playing=playing)
    with right:
        _curves(run, replay, returns, index, frame)


def _scene(replay: Replay, frame: int, choice: ReplayChoice, *, playing: bool) -> None:
    """The robot in 3D, or curves of its observations if there is no robot."""
    if replay.drawn:
        stage(choice, STAGE_HEIGHT, player.PART, compact=True)
        player.panel(replay, playing=playing)
        return
    with st.container(border=True):
        ghost = "" if replay.imagined is None else "; in colour: as the model imagines them"
        st.markdown(f"**Observations**{ghost}")
        figure = observed_curves(replay, frame, CURVE_HEIGHT)
        chart(figure, "replay observations", "observations of the episode, real and imagined")


def _curves(run: RunReader, replay: Replay, returns: np.ndarray, index: int, frame: int) -> None:
    with st.container(border=True):
        st.markdown("**Return**: click a point to see its episodes")
        figure = return_curve(widgets.curve(run, "eval/return"), replay.step, returns, index, 190)
        chart(figure, "replay returns", "return at every evaluation", _choose_episode)

    def mark(point: Point) -> None:
        player.go_to(min(round(point.x / replay.dt), replay.episode.length))

    with st.container(border=True):
        st.markdown("**Reward of each step**: click to go there")
        chart(reward_curve(replay, frame, 180), "replay reward", "reward of each step", mark)
        if replay.imagined is not None:
            st.markdown(
                "**Distance of the ghost from the robot**",
                help="root mean square over the observation's dimensions, each in standard "
                "deviations of its change in one step",
            )
            chart(
                error_curve(replay, frame, 150), "replay error",
                "distance of the imagined state from the real one", mark,
            )  # fmt: skip


def _numbers(replay: Replay) -> None:
    episode = replay.episode
    columns = st.columns(5)
    columns[0].metric("learner", text.markdown(learner_label(replay.learner)))
    columns[1].metric("return", readable.score(episode.undiscounted_return))
    columns[2].metric(
        "length", f"{episode.length:,} steps", help=f"{episode.length * replay.dt:.2f} seconds"
    )
    end = "time limit" if episode.truncated else "terminal state"
    columns[3].metric("ended by", end if episode.truncated or episode.terminated else "-")
    imagined = replay.imagined
    columns[4].metric(
        "return, imagined",
        "-" if imagined is None else readable.score(float(imagined.reward.sum())),
        help="sum of the rewards that the model predicts along the ghost's path",
    )
    if replay.model_step is None:
        st.caption(glossary.linked(f"No ghost: {text.markdown(replay.no_ghost)}."))
    else:
        at, own = f"{replay.model_step:,}", replay.model_step == replay.step
        if replay.ghost is None and replay.drawn:
            st.caption(
                "No ghost: what this task observes does not hold its joints; what the model "
                f"imagined, of step {at}, is compared beside."
            )
            return
        whose = (
            f"the run's model of step {at}"
            if own
            else f"the model that the run kept, of step {at}: not the model of step {replay.step:,}"
        )
        place = (
            ""
            if replay.road or not replay.drawn
            else " Its place on the ground is integrated from its velocity."
        )
        st.caption(glossary.linked(f"The ghost plays the recorded actions in {whose}.{place}"))


def _choose_episode(point: Point) -> None:
    """Choose the evaluation of a clicked point, or the episode of a clicked mark."""
    episode = point.meta[point.index] if point.meta else 1
    timeline.go_to(int(point.x))
    st.session_state["episode"] = episode
    player.go_to(0)
    st.session_state[CHOSEN] = True
