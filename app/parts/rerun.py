"""The Rerun web viewer in a page: one run, live or recorded, on request."""

import streamlit as st

from app import session
from app.data import readers
from tom.record.reader import RunReader

HEIGHT = 720


def frame(run: RunReader) -> None:
    """The viewer of a run, live or recorded. A rerun of the page does not reload it."""
    if not session.links().rerun_port:
        st.caption("The Rerun viewer runs when the studio is started with `tom studio`.")
        return
    st.iframe(_address(run), height=HEIGHT)


def episode(run_id: str, step: int, index: int, horizon: int, height: int) -> None:
    """One evaluation episode, its ghost and its rewards in the viewer."""
    links = session.links()
    if not links.rerun_port:
        st.caption("The Rerun viewer runs when the studio is started with `tom studio`.")
        return
    where = links.rerun_episode(session.host(), run_id, step, index, horizon, session.mode())
    st.iframe(where, height=height)


def _address(run: RunReader) -> str:
    """The address of the live recording of a training run, else of its recordings."""
    links, recorded = session.links(), readers.recordings(run)
    if run.status.alive or not recorded:
        return links.rerun_live(session.host(), run.run_id, session.mode())
    return links.rerun_files(session.host(), run.run_id, recorded, session.mode())
