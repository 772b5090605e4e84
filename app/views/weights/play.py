"""Playback of fits: the page is redrawn with the next fit until the last."""

from collections.abc import Sequence

import streamlit as st

FRAMES = 60
"""maximum number of fits shown during playback"""
TICK_S = 0.5
PLAYS, NEXT = "weights play", "weights next fit"


def button(steps: Sequence[int]) -> bool:
    """A button that plays or pauses; returns whether it plays now.

    Must be called before the choice of the fit, which it changes.
    """
    if NEXT in st.session_state:
        st.session_state["step"] = st.session_state.pop(NEXT)
    plays = bool(st.session_state.get(PLAYS)) and len(steps) > 1
    label, icon = ("Pause", ":material/pause:") if plays else ("Play", ":material/play_arrow:")
    if st.button(label, icon=icon, width="stretch", disabled=len(steps) < 2, on_click=_toggle,
                 args=(list(steps),), key="play fits"):  # fmt: skip
        return bool(st.session_state.get(PLAYS))
    return plays


def go_on(steps: Sequence[int], chosen: int) -> None:
    """Redraw the page with the next fit after a moment; stop at the last one."""
    if chosen == len(steps) - 1:
        st.session_state[PLAYS] = False
        # A tick that was under way carries the browser's slider, which is still at the fit before.
        st.session_state[NEXT] = int(steps[-1])
        st.rerun()
    stride = max(len(steps) // FRAMES, 1)
    _tick(int(steps[min(chosen + stride, len(steps) - 1)]))


def _toggle(steps: list[int]) -> None:
    plays = not st.session_state.get(PLAYS)
    st.session_state[PLAYS] = plays
    if plays and st.session_state.get("step", steps[-1]) == steps[-1]:
        st.session_state["step"] = steps[0]


@st.fragment(run_every=TICK_S)
def _tick(step: int) -> None:
    # The first run is that of the page, so that the user sees that fit for a moment.
    if st.session_state.pop("weights drawn", None) != step:
        st.session_state["weights drawn"] = step
        return
    st.session_state[NEXT] = step
    st.rerun()
