"""The progress of a weighing that a page has started, and what its learners noticed."""

import streamlit as st

from app import text
from app.data.trainings import Started
from app.data.weighings import Weighing


def show_notices(weighing: Weighing) -> None:
    """Say what contradicts itself, and what the learners noticed about their weights."""
    for notice in weighing.notices:
        st.warning(text.markdown(notice), icon=":material/warning:")


def show(key: str) -> None:
    """The output of the weighing that the session holds as `key`; a redraw when it is done."""
    begun: Started | None = st.session_state.get(key)
    if begun is None:
        return
    if begun.process.poll() is None:
        _output(begun)
    elif begun.process.returncode:
        st.error("The weighing ended without a result:", icon=":material/error:")
        st.code(begun.tail(), language=None)
    else:
        del st.session_state[key]
        st.rerun()


@st.fragment(run_every=2)
def _output(begun: Started) -> None:
    if begun.process.poll() is not None:
        st.rerun()
    last = begun.tail().splitlines()[-1:] or ["started"]
    st.caption(f"Weighing: {text.markdown(last[0])}")
