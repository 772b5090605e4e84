"""Replays: recorded episodes in 3D, up to four runs side by side, and a run's film."""

import streamlit as st

from app import text
from app.data import readers
from app.data.called import names
from app.parts import address, rerun
from app.parts.scope import Scope
from app.views.replays import episode, film, side

EPISODE, SIDE, FILM, RERUN = "One episode", "Side by side", "Film", "Rerun"


def page(scope: Scope) -> None:
    """One episode, episodes of several runs, a run's film, or all that a run has recorded."""
    part = address.choose_one(
        st.segmented_control, "Part", [EPISODE, SIDE, FILM, RERUN], "part", EPISODE, required=True,
        label_visibility="collapsed",
    )  # fmt: skip
    if part == SIDE:
        side.draw(scope)
    elif part == FILM:
        film.draw(scope)
    elif part == RERUN:
        _recording(scope)
    else:
        episode.draw(scope)


def _recording(scope: Scope) -> None:
    run = scope.one(lambda run: run.status.alive or bool(readers.recordings(run)), lambda run: 0)
    if run is None:
        st.info("No run here has a Rerun recording; `tom runs export RUN --format rrd` makes one.")
        return
    called = text.markdown(names(scope.runs)[run.run_id])
    st.caption(f"Everything that {called} has recorded, in Rerun's viewer.")
    rerun.frame(run)
