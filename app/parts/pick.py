"""Choices of runs: shown by name, stored in the address by id, so that links stay valid."""

from collections.abc import Mapping, Sequence
from typing import Any

import streamlit as st

from app.parts import address, asked


def one(label: str, names: Mapping[str, str], first: str, key: str) -> str:
    """A run of `names` (id to name), chosen by user or address (`?key=id`), else `first`.

    What was chosen on another page counts here as well, if it is among `names`.
    """
    asked.tell(key, names)
    address.follow(key, first)
    given = address.carried(key)
    wanted = [st.session_state[key]] if given is None else given
    start = next((run_id for run_id in wanted if run_id in names), first)
    moved = key in st.session_state and st.session_state[key] != start
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
    address.carry(key, [] if picked == first else [picked])
    return picked


def many(label: str, names: Mapping[str, str], key: str, **options: Any) -> list[str]:
    """Any number of runs of `names`, in the order of choice; by default none.

    `options` are those of Streamlit's multiselect; of an address no more than its `max_selections`
    are taken.
    """
    asked.tell(key, names)
    given = address.requested(key)
    if given is not None:
        there = [run_id for run_id in given if run_id in names]
        st.session_state[key] = there[: options.get("max_selections")]
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


def _keep(key: str, chosen: list[str], usual: list[str]) -> None:
    """Name a choice in the address, unless it is the default and the address names none."""
    address.keep(key, chosen if chosen != usual or st.query_params.get_all(key) else [])
