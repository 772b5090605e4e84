"""The viser frame as a part of a page."""

import streamlit as st

from app import session, text
from app.scenes.control import Choice, Selection, tell


def stage(choice: Choice, height: int, part: str = "", *, compact: bool = False) -> None:
    """Show `choice` in 3D. A rerun of the page does not reload the frame.

    A page with several frames gives each a different `part`. In a `compact` frame the panel is
    small and closed at first, because it would cover the scene.
    """
    links = session.links()
    if not links.folder:
        st.caption("The 3D scene runs when the studio is started with `tom studio`.")
        return
    client = f"{session.client()}{part}"
    try:
        tell(links.control, client, Selection(choice, session.mode(), compact))
    except OSError:
        said = links.scenes_log.read_text(errors="replace").strip().rpartition("\n")[2]
        st.warning(
            f"The 3D server does not answer; it is started again by itself. {text.markdown(said)}"
        )
    st.iframe(links.viser(client, session.mode()), height=height)
