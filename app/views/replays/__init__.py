"""Replays: recorded episodes in 3D, up to four runs side by side, and a run's film."""

from collections.abc import Sequence

import streamlit as st

from app import session, text
from app.data import readers
from app.data.cache import get_or_make
from app.data.replays import DEFAULT_HORIZON
from app.data.run_names import distinct_names, full_names
from app.figures.weights import over_fits
from app.parts import address, timeline, widgets
from app.parts.plot import chart
from app.parts.scope import Scope
from app.parts.widgets import EVALUATIONS
from app.scenes.control import ReplayChoice
from app.scenes.film import SECONDS, cinema, has_story, story
from app.views.replays import episode
from tom.analysis.weight_readers import first_weight_reader
from tom.errors import UserError
from tom.record.reader import RunReader

EPISODE, SIDE, FILM, RERUN = "One episode", "Side by side", "Film", "Rerun"
MOST = 4
SIDE_HEIGHT, FILM_HEIGHT, RERUN_HEIGHT = 480, 700, 720
LENGTHS = {"15 s": 15.0, "30 s": 30.0, "1 min": SECONDS, "2 min": 120.0}


def page(scope: Scope) -> None:
    """One episode, episodes of several runs, a run's film, or all that a run has recorded."""
    draw = {EPISODE: episode.draw, SIDE: _side_by_side, FILM: _film, RERUN: _recording}
    draw[address.choose_part(list(draw))](scope)


def _recording(scope: Scope) -> None:
    run = scope.choose_run(
        lambda run: run.status.alive or bool(readers.recordings(run)), lambda run: 0
    )
    if run is None:
        st.info("No run here has a Rerun recording; `tom runs export RUN --format rrd` makes one.")
        return
    name = text.markdown(full_names(scope.runs)[run.run_id])
    st.caption(f"Everything that {name} has recorded, in Rerun's viewer.")
    widgets.show_rerun(run, RERUN_HEIGHT)


def _side_by_side(scope: Scope) -> None:
    """Two to four runs: returns and weights on linked axes, replays at one step."""
    runs = scope.shown
    names = full_names(runs)
    of_task = [run for run in runs if run.env == runs[0].env]
    with_replays_first = sorted(of_task, key=lambda run: not run.evaluation_steps())
    of_group = {scope.title(run): run.run_id for run in reversed(with_replays_first)}
    usual = [of_group[title] for title in scope.order if title in of_group][:MOST]
    if len(usual) < 2:
        usual = [run.run_id for run in of_task][:2]
    picked = address.choose_many(
        f"Two to {MOST} runs", list(names), "side", names.__getitem__, usual, max_selections=MOST
    )
    chosen = [run for run_id in picked for run in runs if run.run_id == run_id]
    if len(chosen) < 2:
        st.info("Pick two runs or more.", icon=":material/splitscreen_vertical_add:")
        return
    names = distinct_names(chosen)
    parts = [
        (
            names[run.run_id],
            widgets.curve(run, "eval/return"),
            readers.profiles(first_weight_reader(run)),
        )
        for run in chosen
    ]
    with st.container(border=True):
        st.markdown(
            "**Weights** and **return**: zoom one chart and all follow; weights by position in the "
            "buffer, oldest at the bottom"
        )
        figure = over_fits(parts, session.mode(), 620)
        chart(figure, "side by side", "weights and return of the runs, on linked axes")
    evaluated = {run.run_id: run.evaluation_steps() for run in chosen}
    steps = sorted({step for of_run in evaluated.values() for step in of_run})
    if not steps:
        widgets.show_left_out_of_all(chosen, EVALUATIONS)
        return
    step = timeline.chosen_step(steps)
    timeline.draw([], steps, step)
    played = st.session_state.setdefault("side played", 0)
    with st.container(horizontal=True, vertical_alignment="center"):
        st.markdown("**Replays** of the evaluations at or before one step", width="content")
        if st.button("Play all", icon=":material/play_arrow:"):
            played = st.session_state["side played"] = played + 1
    for first in range(0, len(chosen), 2):
        for i, column in enumerate(st.columns(2)[: len(chosen) - first], first):
            run = chosen[i]
            with column:
                _replay(run, names[run.run_id], evaluated[run.run_id], step, f"side{i}", played)


def _replay(
    run: RunReader, name: str, steps: Sequence[int], step: int, part: str, played: int
) -> None:
    """The last evaluation at or before a step, played `played` times from its start."""
    before = [at for at in steps if at <= step]
    if before:
        words = f"step {before[-1]:,}"
    elif {EVALUATIONS, f"other {EVALUATIONS}"}.isdisjoint(run.left_out):
        words = "not evaluated yet"
    else:
        words = "left out of its small copy"
    st.caption(f"{text.markdown(name)}, {words}")
    if before:
        choice = ReplayChoice(str(run.path), before[-1], 0, 0, DEFAULT_HORIZON, played, "start")
        widgets.show_scene(choice, SIDE_HEIGHT, part)


def _film(scope: Scope) -> None:
    """A run's whole story in a minute on one timeline, on the page and as a file."""
    run = scope.choose_run(has_story, widgets.interest_key)
    if run is None:
        st.info("No run here has a story yet: it needs two model fits and its buffer (MuJoCo).")
        return
    top = st.columns([6, 2], vertical_alignment="bottom")
    chosen = address.choose_one(
        top[0].segmented_control, "Length", list(LENGTHS), "length", "1 min", required=True
    )
    try:
        with st.spinner("Making the film..."):
            version = run.version("metrics"), run.name  # the film has the name as its title
            story_data = get_or_make(("story", run.path), version, lambda: story(run))
    except UserError as error:
        widgets.show_left_out(run, "buffer")
        st.warning(text.markdown(error))
        return
    film = cinema(story_data, run.learner, session.mode(), LENGTHS[chosen])
    top[1].download_button(
        "One HTML file", film, f"{run.run_id}-cinema.html", "text/html", key="film",
        width="stretch", icon=":material/download:", on_click="ignore",
        help="opens without a server or a network",
    )  # fmt: skip
    st.iframe(film, height=FILM_HEIGHT, alt="Film")
    st.caption(
        "A robot's or point's colour is the mean weight of its hundredth of the buffer at each "
        "fit. In front: an evaluation of the newest policy kept by then, at half speed. Space "
        "plays and pauses, arrows move one second. MP4 needs a browser that can encode, on this "
        "machine or over https; `tom studio --cinema` writes an MP4 too."
    )
    widgets.show_left_out(run, "other evaluations")
