"""Drawing a page again once something that it shows has changed."""

from collections.abc import Callable

import streamlit as st


def when_changed(state: Callable[[], object], every_s: float) -> None:
    """Draw the whole page again when `state`, looked at every few seconds, is another than now."""
    seen: dict[str, object] = {}

    @st.fragment(run_every=every_s)
    def look() -> None:
        now = state()
        if now != seen.setdefault("first", now):
            st.rerun()

    look()
