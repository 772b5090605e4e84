"""The progress of a weighing that a page has started."""

import streamlit as st

from app import text
from app.data.trainings import Started


@st.fragment(run_every=2)
def progress(key: str) -> None:
    """The output of the weighing that the session holds as `key`; a redraw when it is done."""
    begun: Started | None = st.session_state.get(key)
    if begun is None:
        return
    if begun.process.poll() is None:
        last = begun.tail().splitlines()[-1:] or ["started"]
        st.caption(f"Weighing: {text.markdown(last[0])}")
        return
    if begun.process.returncode:
        st.error("The weighing ended without a result:", icon=":material/error:")
        st.code(begun.tail(), language=None)
        return
    del st.session_state[key]
    st.rerun()
