"""Two to four runs side by side: returns and weights on linked axes, replays at one step."""

from collections.abc import Mapping, Sequence

import streamlit as st

from app import session, text
from app.data import readers
from app.data.called import names, told_apart
from app.data.replays import DEFAULT_HORIZON
from app.figures.weights import side_by_side
from app.parts import address, empty, timeline
from app.parts.plot import chart
from app.parts.scope import Scope
from app.parts.stage import stage
from app.scenes.control import ReplayChoice
from app.views.curves import measure
from tom.record.reader import RunReader

MOST = 4
STAGE_HEIGHT = 480


def draw(scope: Scope) -> None:
    """The choice of runs, then their figures and their robots, one column per run."""
    runs = scope.shown
    called = names(runs)
    picked = address.choose_many(
        f"Two to {MOST} runs", list(called), "side", called.__getitem__, default_runs(scope),
        max_selections=MOST,
    )  # fmt: skip
    chosen = [run for run_id in picked for run in runs if run.run_id == run_id]
    if len(chosen) < 2:
        st.info("Pick two runs or more.", icon=":material/splitscreen_vertical_add:")
        return
    called = told_apart(chosen)
    parts = [
        (
            called[run.run_id],
            measure.curve(run, "eval/return"),
            readers.profiles(run),
        )
        for run in chosen
    ]
    with st.container(border=True):
        st.markdown(
            "**Return** and **weights**: zoom one and all follow; weights by position in the "
            "buffer, oldest at the bottom"
        )
        figure = side_by_side(parts, session.mode(), 620)
        chart(figure, "side by side", "return and weights of the runs, on linked axes")
    _replays(chosen, called)


def default_runs(scope: Scope) -> list[str]:
    """The newest shown run of each of the first groups, of one task."""
    runs = [run for run in scope.shown if run.env == scope.shown[0].env] if scope.shown else []
    newest = {scope.title(run): run.run_id for run in reversed(runs)}
    first = [newest[title] for title in scope.order if title in newest][:MOST]
    return first if len(first) > 1 else [run.run_id for run in runs][:2]


def _replays(chosen: Sequence[RunReader], called: Mapping[str, str]) -> None:
    evaluated = {run.run_id: run.evaluation_steps() for run in chosen}
    steps = sorted({step for of_run in evaluated.values() for step in of_run})
    if not steps:
        for run in chosen:
            empty.left_out(run, empty.EVALUATIONS)
        return
    st.markdown("**Replays** of the evaluations at or before one step")
    step = timeline.chosen(steps)
    timeline.draw([], steps, step)
    row = st.columns([5, 1], vertical_alignment="bottom")
    played = st.session_state.setdefault("side played", 0)
    if row[1].button("Play all", icon=":material/play_arrow:", width="stretch"):
        played = st.session_state["side played"] = played + 1
    columns: list = []
    for i, run in enumerate(chosen):
        columns = list(st.columns(2)) if i % 2 == 0 else columns
        before = [at for at in evaluated[run.run_id] if at <= step]
        with columns[i % 2]:
            words = f"step {before[-1]:,}" if before else _without(run)
            st.caption(f"{text.markdown(called[run.run_id])}, {words}")
            if before:
                choice = ReplayChoice(
                    run.run_id, before[-1], 0, 0, DEFAULT_HORIZON, played, "start"
                )
                stage(choice, STAGE_HEIGHT, f"side{i}", compact=True)


def _without(run: RunReader) -> str:
    """Why a run has no replay at or before the chosen step."""
    parts = {empty.EVALUATIONS, f"other {empty.EVALUATIONS}"}
    return "not evaluated yet" if parts.isdisjoint(run.left_out) else "left out of its small copy"
