"""The progress of a weighing or a brush that a page has started, and what its learners noticed."""

import streamlit as st

from app import text
from app.data.trainings import Started
from app.data.weighings import Weighing


def show_notices(weighing: Weighing) -> None:
    """Say what contradicts itself, and what the learners noticed about their weights."""
    for notice in weighing.notices:
        st.warning(text.markdown(notice), icon=":material/warning:")


def show(key: str, chosen: str = "") -> None:
    """The progress of the process that the session holds as `key`; a redraw when it is done.

    Its result is then the newest: the choice `chosen` among results is forgotten.
    """
    begun: Started | None = st.session_state.get(key)
    if begun is None:
        return
    if begun.process.poll() is None:
        _goes_on(key, begun)
    elif begun.process.returncode:
        st.error(text.markdown(begun.tail()), icon=":material/error:")
    else:
        del st.session_state[key]
        if chosen:
            st.session_state.pop(chosen, None)
        st.rerun()


@st.fragment(run_every=1)
def _goes_on(key: str, begun: Started) -> None:
    """The last line of its output, and a button that ends it."""
    if begun.process.poll() is not None:
        st.rerun()
    last = (begun.tail().splitlines()[-1:] or ["started"])[0]
    columns = st.columns([5, 1], vertical_alignment="center")
    columns[0].progress(_share(last), text.markdown(last))
    if columns[1].button("Cancel", key=f"cancel {key}"):
        begun.process.terminate()
        begun.process.wait()
        del st.session_state[key]
        st.rerun()


def _share(line: str) -> float:
    """`model 3 of 12: ...` -> the completed share; 0 for lines that do not say it."""
    words = line.replace(":", "").split()
    try:
        return min(int(words[1]) / int(words[3]), 1.0)
    except (IndexError, ValueError, ZeroDivisionError):
        return 0.0
