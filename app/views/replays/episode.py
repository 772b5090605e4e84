"""One evaluation episode in 3D, with the prediction of the run's model.

The scene has the clock; the page controls it and follows it.
"""

import numpy as np
import streamlit as st

from app import session, text
from app.data import readers, replays
from app.data.replays import DEFAULT_HORIZON, HORIZONS, Replay
from app.data.run_names import full_names
from app.figures.replay import episode_curves, observed_curves, return_curve
from app.parts import address, timeline, widgets
from app.parts.plot import Point, chart
from app.parts.scope import Scope
from app.scenes.control import REAL_TIME, SPEEDS, Clock, Command, ReplayChoice, clock
from tom import readable
from tom.envs import ROAD
from tom.errors import UserError
from tom.learners import learner_label
from tom.record.reader import RunReader, at_or_before

VISER, RERUN = "3D scene", "Rerun"
STAGE_HEIGHT, CURVE_HEIGHT = 520, 150
TICK_S, LISTEN_S = 0.5, 4
"""how often the page asks the scene for its clock: while it plays, and otherwise"""
PART = "replay"
"""the name of the frame on its page"""
FRAME, SLIDER = "frame", "replay frame"
REQUEST = "replay asked"
"""the page's requests: their number, the last one, and its frame"""
NO_REQUEST = (0, "go", 0)
CHOSEN = "another episode was chosen"


def draw(scope: Scope) -> None:
    """A run, an evaluation, an episode; the robot, its return and its reward."""
    run = scope.choose_run(lambda run: bool(run.evaluation_steps()), widgets.interest_key)
    scope.show_missing(run, "evaluations")
    if run is None:
        if not widgets.show_left_out_of_all(scope.runs, widgets.EVALUATIONS):
            st.info("No run here has been evaluated yet: its episodes are recorded then.")
        return
    steps, fits = run.evaluation_steps(), readers.profiles(run).env_step.tolist()
    asked = timeline.chosen_step(sorted({*fits, *steps}))
    step = at_or_before(steps, asked)
    timeline.draw(fits, steps, asked)
    returns = readers.returns(run, step)
    if not len(returns):
        st.warning("The episodes of this evaluation cannot be read.")
        return
    name = text.markdown(full_names(scope.runs)[run.run_id])
    top = st.columns([6, 3, 3], vertical_alignment="bottom")
    top[0].header(f"{name}, evaluated at step {step:,}", anchor=False)
    options = list(range(1, len(returns) + 1))
    label = f"Episode (of {len(returns)})"
    index = address.choose_one(top[1].selectbox, label, options, "episode", 1) - 1
    horizon = address.choose_one(
        top[2].selectbox, "Ghost starts again every", HORIZONS, "ghost", DEFAULT_HORIZON,
        lambda n: "whole episode" if n == HORIZONS[-1] else f"{n} step{'s' * (n > 1)}",
    )  # fmt: skip
    try:
        replay = replays.load(run, step, index, horizon)
    except UserError as error:
        st.warning(text.markdown(error))
        return
    if replay is None:
        st.warning("This episode cannot be read.")
        return
    _numbers(replay)
    kept = [fit for fit in run.snapshot_steps() if fit <= step]
    if kept and run.env != ROAD:
        label = f"The buffer's newest episode at step {kept[-1]:,}, on its map"
        where = {"run": run.run_id, "step": str(kept[-1])}
        newest = readers.profiles(run).rows_at(kept[-1]) - 1
        widgets.link_to("attention", label, row=str(newest), **where)
    _, moves = position()
    play = st.fragment(_play, run_every=TICK_S if moves else None)
    play(run, replay, returns, index, horizon, moves=moves)
    if not moves:
        widgets.redraw_when_changed(position, LISTEN_S)
    widgets.show_left_out(run, "other evaluations", "other episodes")
    widgets.show_problems(run)


def _numbers(replay: Replay) -> None:
    episode, imagined = replay.episode, replay.imagined
    end = "time limit" if episode.truncated else "terminal state"
    dreamt = None if imagined is None else float(imagined.reward.sum())
    numbers = {
        "learner": text.markdown(learner_label(replay.learner)),
        "return": readable.score(episode.undiscounted_return),
        "length": f"{episode.length:,} steps",
        "ended by": end if episode.truncated or episode.terminated else "-",
        "return, imagined": readable.score(dreamt),
    }
    helps = {
        "length": f"{episode.length * replay.dt:.2f} seconds",
        "return, imagined": "sum of the rewards that the model predicts along the ghost's path",
    }
    widgets.metrics(numbers, helps)
    if replay.model_step is None:
        words = f"No ghost: {text.markdown(replay.no_ghost)}."
    elif replay.ghost is None and replay.has_scene:
        words = (
            "No ghost: this task's observations do not include its joints. The charts compare what "
            f"the model of step {replay.model_step:,} imagined."
        )
    else:
        words = "The ghost plays the recorded actions in " + (
            f"the run's model of step {replay.model_step:,}."
            if replay.model_step == replay.step
            else f"the model that the run kept, of step {replay.model_step:,}, not of step "
            f"{replay.step:,}."
        )
        if replay.has_scene and not replay.road:
            words += " Its place on the ground is integrated from its velocity."
    st.caption(text.with_glossary_links(words))


def _play(
    run: RunReader, replay: Replay, returns: np.ndarray, index: int, horizon: int, *, moves: bool
) -> None:
    """The episode and its charts, which follow the clock of the scene during playback."""
    if st.session_state.pop(CHOSEN, False) or position()[1] != moves:
        st.rerun()  # the choice of a click here is read above, and so is whether to follow
    at, playing = position()  # the scene plays, or has controls of its own
    if FRAME in st.session_state:
        st.session_state[FRAME] = min(at, replay.episode.length)
    frame = _current_frame(replay, playing=playing)
    left, right = st.columns([3, 2])
    with left:
        viewer = address.choose_part([VISER, RERUN], "viewer", "Viewer")
        if viewer == RERUN:
            name = f"episode-{replay.step}-{index}-{horizon}.rrd"
            widgets.show_rerun(run, STAGE_HEIGHT, name)
        elif replay.has_scene:
            request, command, at = st.session_state.get(REQUEST, NO_REQUEST)
            state = st.session_state
            choice = ReplayChoice(
                str(run.path), replay.step, index, at, horizon, request=request, command=command,
                speed=state.get("replay speed", REAL_TIME),
                ghost=bool(state.get("replay ghost", True)),
                follow=bool(state.get("replay follows", True)),
            )  # fmt: skip
            widgets.show_scene(choice, STAGE_HEIGHT, PART)
            _controls(replay, playing=playing)
        else:
            with st.container(border=True):
                ghost = "" if replay.imagined is None else "; in colour, what the model imagines"
                st.markdown(f"**Observations**{ghost}")
                figure = observed_curves(replay, frame, CURVE_HEIGHT)
                label = "observations of the episode, real and imagined"
                chart(figure, "replay observations", label)
    with right:
        _curves(run, replay, returns, index, frame)


def _curves(run: RunReader, replay: Replay, returns: np.ndarray, index: int, frame: int) -> None:
    with st.container(border=True):
        st.markdown("**Return**: click a point to see its episodes")
        figure = return_curve(widgets.curve(run, "eval/return"), replay.step, returns, index, 190)
        chart(figure, "replay returns", "return at every evaluation", _choose_episode)

    def mark(point: Point) -> None:
        go_to(min(round(point.x / replay.dt), replay.episode.length))

    with st.container(border=True):
        far = " and **distance of the ghost from the robot**" * (replay.imagined is not None)
        st.markdown(
            f"**Reward of each step**{far}: click to go there",
            help="distance: root mean square over the observation's dimensions, each in standard "
            "deviations of its change in one step",
        )
        label = "reward of each step of the episode, and the ghost's distance if it has one"
        chart(episode_curves(replay, frame, 170), "replay reward", label, mark)


def _choose_episode(point: Point) -> None:
    """Choose the evaluation of a clicked point, or the episode of a clicked mark."""
    timeline.go_to(int(point.x))
    st.session_state["episode"] = point.meta[point.index] if point.meta else 1
    go_to(0)
    st.session_state[CHOSEN] = True


def position() -> tuple[int, bool]:
    """The scene's step and whether it plays; the page's wish until the scene has heard it."""
    now, (request, command, _) = _clock(), st.session_state.get(REQUEST, NO_REQUEST)
    if now is None or now.request != request:
        return st.session_state.get(FRAME, 0), now is not None and command == "play"
    return now.frame, now.playing


def _current_frame(replay: Replay, *, playing: bool) -> int:
    """The shown step of the episode: the scene's, or that of the address, which a pause writes."""
    before = st.session_state.get(FRAME)
    frame = address.value_of(FRAME, address.whole_number) or 0
    if frame > replay.episode.length:  # chosen in a longer episode
        frame = 0
    if frame != before:
        go_to(frame)
    address.write(FRAME, [str(frame)] if frame and not playing else [])
    return frame


def go_to(frame: int) -> None:
    st.session_state[FRAME] = frame
    _send_request("go", frame)


def _controls(replay: Replay, *, playing: bool) -> None:
    """Below the stage: play or pause, the step, the speed, the ghost, the camera."""
    last = replay.episode.length

    def toggle() -> None:
        now = _clock()
        if now is not None and now.playing:
            st.session_state[FRAME] = now.frame
            _send_request("pause", now.frame)
            return
        if st.session_state[FRAME] >= last:
            st.session_state[FRAME] = 0
        _send_request("play", st.session_state[FRAME])

    icon = ":material/pause:" if playing else ":material/play_arrow:"
    row = st.columns([2, 6, 3], vertical_alignment="bottom")
    label = "Pause" if playing else "Play"
    row[0].button(label, icon=icon, key="replay play", width="stretch", on_click=toggle)
    slider = f"{SLIDER} of {last}"  # Streamlit puts one of another range back to its beginning
    if st.session_state.get(slider) != st.session_state[FRAME]:  # else it would interrupt a drag
        st.session_state[slider] = st.session_state[FRAME]
    row[1].slider(
        "Step of the episode", 0, last, key=slider,
        on_change=lambda: go_to(int(st.session_state[slider])),
    )  # fmt: skip
    row[2].selectbox("Speed", list(SPEEDS), list(SPEEDS).index(REAL_TIME), key="replay speed")
    row = st.columns(2)
    row[0].toggle("Model's ghost", True, key="replay ghost", disabled=replay.ghost is None)
    row[1].toggle("Camera follows", True, key="replay follows")


def _send_request(command: Command, frame: int) -> None:
    request = st.session_state.get(REQUEST, NO_REQUEST)[0]
    st.session_state[REQUEST] = (request + 1, command, frame)


def _clock() -> Clock | None:
    """The scene's clock; None also if there is no scene server."""
    links = session.links()
    if not links.folder:
        return None
    try:
        return clock(str(links.file("control")), f"{session.client()}{PART}")
    except OSError:
        return None
