"""The replay of a clicked point, beside the figure."""

from collections.abc import Sequence
from urllib.parse import quote

import numpy as np
import streamlit as st

from app import text
from app.data.replays import DEFAULT_HORIZON
from app.parts import address, replay_link
from app.parts.plot import Point
from app.parts.stage import stage
from app.scenes.control import ReplayChoice
from tom.analysis.curves import Curve
from tom.record.reader import RunReader

HEIGHT = 400
REPLAY = "replay"
"""in the address: `replay=hopper-tom-s0~20000`"""
NOTHING = ("", 0)


def remember(curves: Sequence[Curve], point: Point) -> None:
    """Store a clicked point of a line; on a mean it means the run that is nearest there."""
    if isinstance(point.meta, str):
        run_id = point.meta
    elif isinstance(point.meta, list) and point.meta:
        run_id = nearest([c for c in curves if c.run_id in point.meta], point.x, point.y)
    else:
        return
    st.session_state[replay_link.CLICKED] = (run_id, int(point.x))


def nearest(curves: Sequence[Curve], x: float, y: float) -> str:
    """The run whose value at `x` is nearest to `y`, of those that reach `x`; empty if none does."""
    there = [c for c in curves if len(c.step) and c.step[0] <= x <= c.step[-1]]
    gaps = [abs(float(np.interp(x, c.step, c.value)) - y) for c in there]
    return there[int(np.argmin(gaps))].run_id if gaps else ""


def clicked_replay(runs: Sequence[RunReader]) -> tuple[RunReader, int, int] | None:
    """The run, the clicked step, and the evaluation nearest to it whose episodes were recorded.

    None if nothing was clicked or the run has no recorded episodes.
    """
    given = address.requested(REPLAY)
    if given is not None:
        st.session_state[REPLAY] = ""
        st.session_state[replay_link.CLICKED] = run_and_step(given)
    run_id, step = st.session_state.get(replay_link.CLICKED, NOTHING)
    run = next((run for run in runs if run.run_id == run_id), None)
    steps = run.evaluation_steps() if run else []
    if run is None or not steps:
        return None
    address.keep(REPLAY, [f"{run_id}~{step}"])
    return run, step, min(steps, key=lambda evaluated: abs(evaluated - step))


def run_and_step(words: Sequence[str]) -> tuple[str, int]:
    """The run and the step from an address, which names them as `run~step`."""
    run_id, _, digits = "".join(words[-1:]).rpartition("~")
    step = text.whole(digits)
    return NOTHING if step is None else (run_id, step)


def show(run: RunReader, clicked: int, step: int, called: str) -> None:
    """The robot at the evaluation `step`, with a line that calls the run by its name."""
    asked = "" if step == clicked else f", the nearest that is kept to step {clicked:,}"
    address = f"/replays?run={quote(run.run_id)}&step={step}"
    head, close = st.columns([6, 1], vertical_alignment="center")
    head.markdown(f"[Replay of {text.markdown(called)}, step {step:,}]({address}){asked}")
    close.button("", icon=":material/close:", key="close replay", help="close", on_click=_forget)
    stage(
        ReplayChoice(run.run_id, step, 0, 0, DEFAULT_HORIZON, 1, "start"),
        HEIGHT,
        "compare",
        compact=True,
    )


def _forget() -> None:
    st.session_state.pop(replay_link.CLICKED, None)
