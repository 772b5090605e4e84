"""A link from a point of a run's curve to the episodes at that step."""

from collections.abc import Mapping, Sequence
from urllib.parse import quote

import streamlit as st

from app import text
from app.parts.plot import Point
from tom.record.reader import RunReader

CLICKED = "clicked point"


def remember(point: Point) -> None:
    """Store a clicked point of a single run's line."""
    if isinstance(point.meta, str):
        st.session_state[CLICKED] = (point.meta, int(point.x))


def show(runs: Sequence[RunReader], called: Mapping[str, str]) -> None:
    """A link to the episodes of the last clicked point, if it belongs to one of `runs`.

    `called` has their names.
    """
    run_id, step = st.session_state.get(CLICKED, ("", 0))
    run = next((run for run in runs if run.run_id == run_id), None)
    steps = run.evaluation_steps() if run else []
    if run is None or not steps:
        st.caption("Click a point of a single run for its replay.")
        return
    at = min(steps, key=lambda evaluated: abs(evaluated - step))
    address = f"/replays?run={quote(run_id)}&step={at}"
    st.markdown(f"[Replay of {text.markdown(called[run_id])}, step {at:,}]({address})")
