"""The Rerun web viewer as a part of a page: what trains now, or what a run recorded."""

from collections.abc import Sequence

import streamlit as st

from app import session
from app.data import readers
from app.data.readers import RunInfo
from app.parts import asked

LIVE = "what is training now"
HEIGHT = 720
CHOICE, AUTOMATIC = "recording", "rerun automatic"
"""what the reader chose, and what is shown until then, in the session's state"""


def settle(runs: Sequence[RunInfo], watched: Sequence[RunInfo]) -> None:
    """Decide what is shown until the reader chooses; before `look_again` asks whether it fits.

    A viewer that shows the old automatic choice goes along with the new one.
    """
    before = st.session_state.get(AUTOMATIC)
    now = st.session_state[AUTOMATIC] = source(runs, watched)
    if before is not None and st.session_state.get(CHOICE) == before:
        st.session_state[CHOICE] = now


def frame(runs: Sequence[RunInfo]) -> None:
    """The viewer, and the choice of what it shows. A rerun of the page does not reload it."""
    links = session.links()
    st.subheader("Recording", anchor=False)
    if not links.rerun_port:
        st.caption("The Rerun viewer runs when the studio is started with `tom studio`.")
        return
    recorded = [run.run_id for run in runs if readers.recordings(run)]
    automatic = st.session_state[AUTOMATIC]
    options = [automatic, *(name for name in [LIVE, *recorded] if name != automatic)]
    asked.tell(CHOICE, options)
    chosen = st.selectbox(
        "Show in Rerun",
        options,
        key=CHOICE,
        bind="query-params",
        on_change=asked.answered,
        args=(CHOICE,),
    )
    run = next((run for run in runs if run.run_id == chosen), None)
    if run is None and not any(run.status.alive for run in runs):
        st.info(
            "Nothing is training: choose a recording above."
            if recorded
            else "Nothing is training, and no run here was recorded for Rerun."
        )
        return
    if run is None:
        address = links.rerun_live(session.host(), session.mode())
    else:
        names = readers.recordings(run)
        address = links.rerun_files(session.host(), run.run_id, names, session.mode())
    st.iframe(address, height=HEIGHT)


def episode(run_id: str, step: int, index: int, horizon: int, height: int) -> None:
    """One evaluation episode, its ghost and its rewards in the viewer."""
    links = session.links()
    if not links.rerun_port:
        st.caption("The Rerun viewer runs when the studio is started with `tom studio`.")
        return
    where = links.rerun_episode(session.host(), run_id, step, index, horizon, session.mode())
    st.iframe(where, height=height)


def source(runs: Sequence[RunInfo], watched: Sequence[RunInfo]) -> str:
    """What to show: the hub while a run trains, else the newest recording, of the watched first."""
    if any(run.status.alive for run in runs):
        return LIVE
    newest = sorted(watched, key=lambda run: run.created, reverse=True)
    return next((run.run_id for run in (*newest, *runs) if readers.recordings(run)), LIVE)


def look_again(runs: Sequence[RunInfo], watched: Sequence[RunInfo]) -> None:
    """Draw the page again when the first training has begun, or the last one has ended.

    The page must `settle` anew before it comes here once more, or it would never get further.
    """
    shown, now = st.session_state[AUTOMATIC], source(runs, watched)
    if (shown == LIVE) != (now == LIVE):
        st.rerun()
