"""The runs that have no part in a comparison, by name and with the reason."""

from collections.abc import Mapping, Sequence

import streamlit as st

from app import text
from app.data.called import short_names
from app.data.readers import RunInfo


def show(runs: Sequence[RunInfo], left_out: Mapping[str, Sequence[RunInfo]]) -> None:
    """Name the runs that are left out of `runs`, a line for each reason."""
    called = short_names(runs)
    for reason, of in left_out.items():
        if of:
            said = "; ".join(called[run.run_id] for run in of)
            st.caption(f"Left out, {reason}: {text.markdown(said)}.")
