"""The runs that have no part in a comparison, by name and with the reason."""

from collections.abc import Mapping, Sequence

import streamlit as st

from app import text
from app.data.called import short_names
from tom.record.reader import RunReader

FEW = 8
"""runs that are named in the line; more are named in its help"""


def show(runs: Sequence[RunReader], left_out: Mapping[str, Sequence[RunReader]]) -> None:
    """Name the runs that are left out of `runs`, a line for each reason."""
    called = short_names(runs)
    for reason, of in left_out.items():
        if of:
            named = text.markdown("; ".join(called[run.run_id] for run in of))
            if len(of) <= FEW:
                st.caption(f"Left out, {reason}: {named}.")
            else:
                st.caption(f"Left out, {reason}: {len(of)} runs.", help=named)
