"""The viser frame as a part of a page."""

import streamlit as st

from app import session
from app.scenes.control import Choice, Selection, tell


def stage(choice: Choice, height: int, part: str = "", *, compact: bool = False) -> None:
    """Show `choice` in 3D. A rerun of the page does not reload the frame.

    A page with several frames gives each a different `part`. In a `compact` frame the panel is
    small and closed at first, because it would cover the scene.
    """
    links = session.links()
    if not links.viser_port:
        st.caption("The 3D scene runs when the studio is started with `tom studio`.")
        return
    client = f"{session.client()}{part}"
    try:
        tell(links.control, client, Selection(choice, session.mode(), compact))
    except OSError:
        st.warning("The 3D server does not answer; it is started again by itself.")
    st.iframe(links.viser(session.host(), client, session.mode()), height=height)
