"""The Rerun web viewer in a page: one run, live or recorded, on request."""

from collections.abc import Sequence

import streamlit as st

from app import session
from app.data import readers
from app.data.called import names
from app.parts import pick
from tom.record.reader import RunReader

NOTHING = ""
HEIGHT = 720
CHOICE = "recording"


def frame(runs: Sequence[RunReader]) -> None:
    """The viewer of a run that the user chooses; nothing is loaded before.

    A rerun of the page does not reload it.
    """
    links = session.links()
    if not links.rerun_port:
        st.caption("The Rerun viewer runs when the studio is started with `tom studio`.")
        return
    by_id = {run.run_id: run for run in runs if run.status.alive or readers.recordings(run)}
    called = {NOTHING: "no run: the viewer is not loaded", **names(list(by_id.values()))}
    chosen = by_id.get(pick.one("Show in Rerun", called, NOTHING, CHOICE))
    if chosen is not None:
        st.iframe(_address(chosen), height=HEIGHT)


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
