"""Two to four runs side by side: returns and weights on linked axes, replays at one step."""

from collections.abc import Mapping, Sequence

import streamlit as st

from app import session, text
from app.data import readers
from app.data.called import told_apart
from app.data.replays import DEFAULT_HORIZON
from app.figures.weights import side_by_side
from app.parts import address, asked, empty
from app.parts.plot import chart
from app.parts.stage import stage
from app.scenes.control import ReplayChoice
from app.views.compare import measure
from app.views.compare.choice import names_with_ids
from app.views.compare.comparison import Comparison
from tom.record.reader import RunReader

MOST = 4
UNTIL = "until"
STAGE_HEIGHT = 480


def draw(comparison: Comparison) -> None:
    """The choice of runs, then their figures and their robots, one column per run."""
    runs = comparison.shown
    names = names_with_ids(runs)
    asked.tell("side", names)
    picked = address.choose_many(
        f"Two to {MOST} runs", list(names), "side", names.__getitem__, default_runs(runs),
        max_selections=MOST, on_change=asked.answered, args=("side",),
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


def default_runs(runs: Sequence[RunReader]) -> list[str]:
    """The newest run of each learner in the environment of the newest run."""
    if not runs:
        return []
    newest = {run.learner: run.run_id for run in reversed(runs) if run.env == runs[0].env}
    first = list(newest.values())[:MOST]
    return first if len(first) > 1 else [run.run_id for run in runs if run.env == runs[0].env][:2]


def _replays(chosen: Sequence[RunReader], called: Mapping[str, str]) -> None:
    evaluated = {run.run_id: run.evaluation_steps() for run in chosen}
    steps = sorted({step for of_run in evaluated.values() for step in of_run})
    if not steps:
        for run in chosen:
            empty.left_out(run, empty.EVALUATIONS)
        return
    st.markdown("**Replays** of the evaluations at or before one step")
    # The first choice is a step that all of them have reached.
    step = min(of_run[-1] for of_run in evaluated.values() if of_run)
    row = st.columns([5, 1], vertical_alignment="bottom")
    with row[0]:
        step = address.choose_step("At step", steps, step, UNTIL, of=chosen[0].env)
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
