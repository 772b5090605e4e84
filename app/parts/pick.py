"""Choices of runs: shown by name, stored in the address by id, so that links stay valid."""

from collections.abc import Mapping, Sequence
from typing import Any

import streamlit as st

from app.parts import asked


def one(label: str, names: Mapping[str, str], first: str, key: str) -> str:
    """A run of `names` (id to name), chosen by user or address (`?key=id`), else `first`.

    What was chosen on another page counts here as well, if it is among `names`.
    """
    asked.tell(key, names)
    given, held = _given(key, names), str(st.session_state.get(key, _chosen().get(key)))
    start = given[0] if given else held if held in names else first
    moved = key in st.session_state and held != start
    if moved:
        st.session_state[key] = start
    chosen = st.selectbox(
        label,
        list(names),
        # The default of the widget itself: a value set from here is told to the browser once, and
        # lost if the page is drawn again, as Live is, before the browser has made the widget.
        0 if moved else list(names).index(start),
        key=key,
        format_func=lambda run_id: names.get(run_id, run_id),
        on_change=asked.answered,
        args=(key,),
    )
    picked = chosen if chosen in names else first
    _keep(key, [picked], [first])
    if key in st.query_params:
        _chosen()[key] = picked
    return picked


def many(label: str, names: Mapping[str, str], key: str, **options: Any) -> list[str]:
    """Any number of runs of `names`, in the order of choice; by default none.

    `options` are those of Streamlit's multiselect; of an address no more than its `max_selections`
    are taken.
    """
    asked.tell(key, names)
    if given := _given(key, names):
        st.session_state[key] = given[: options.get("max_selections")]
    chosen: Sequence[str] = st.multiselect(
        label,
        list(names),
        key=key,
        format_func=lambda run_id: names.get(run_id, run_id),
        on_change=asked.answered,
        args=(key,),
        filter_mode="contains",
        select_all=False,
        **options,
    )
    picked = [run_id for run_id in chosen if run_id in names]
    _keep(key, picked, [])
    return picked


def _given(key: str, names: Mapping[str, str]) -> list[str]:
    """The existing runs in the address, unless this page has put them there."""
    given = st.query_params.get_all(key)
    if given == _kept().get(key, []):
        return []
    return [run_id for run_id in given if run_id in names]


def _keep(key: str, chosen: list[str], usual: list[str]) -> None:
    """Put a choice into the address, unless it is the default and the address names none."""
    if chosen != usual or (chosen and key in st.query_params):
        if st.query_params.get_all(key) != chosen:
            st.query_params[key] = chosen
    else:
        st.query_params.pop(key, None)
    _kept()[key] = st.query_params.get_all(key)


def _kept() -> dict[str, list[str]]:
    """The choices that this tab's pages have put into the address, by parameter."""
    return st.session_state.setdefault("runs in the address", {})


def _chosen() -> dict[str, str]:
    """The run that was last chosen in this tab, by parameter: widgets forget it with their page."""
    return st.session_state.setdefault("runs chosen", {})
