"""The Rerun web viewer in a page: recordings of one run, on request."""

from collections.abc import Sequence

import streamlit as st

from app import session
from app.data import readers
from app.links import LIVE
from tom.record.reader import RunReader

HEIGHT = 720


def frame(run: RunReader) -> None:
    """The viewer of a run: live while it trains, else what it recorded."""
    recorded = readers.recordings(run)
    show(run.run_id, [LIVE] if run.status.alive or not recorded else recorded, HEIGHT)


def show(run_id: str, names: Sequence[str], height: int) -> None:
    """These recordings of a run in the viewer. A rerun of the page does not reload it."""
    links = session.links()
    if not links.folder:
        st.caption("The Rerun viewer runs when the studio is started with `tom studio`.")
        return
    st.iframe(links.rerun(run_id, names, session.mode()), height=height)
