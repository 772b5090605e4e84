"""Runs that an address asks for and that are not there: said, not replaced in silence."""

from collections.abc import Collection
from urllib.parse import urlsplit

import streamlit as st

from app import session, text
from app.data import readers
from tom.record import manage
from tom.record.store import Store

LONGEST = 120
"""letters that are shown of an id, which may be anything"""


def tell(name: str, there: Collection[str]) -> None:
    """Say which runs the address names as `name=` that are not among the page's, `there`.

    To be called before the widget of that name is made, which drops them from the address. What
    was said stays until the reader chooses there (`answered`).
    """
    unknown = [run_id for run_id in st.query_params.get_all(name) if run_id not in there]
    if unknown:
        _open()[name] = unknown
    for run_id in _open().get(name, ()):
        st.warning(f"{why(run_id)} Something else is shown.", icon=":material/link_off:")


def answered(name: str) -> None:
    """The reader has chosen by hand: what the address asked for is forgotten."""
    _open().pop(name, None)


def why(run_id: str) -> str:
    """Where a run is that a page does not show, in Markdown."""
    store = session.links().store
    called = text.markdown(run_id[:LONGEST])
    if any(run.run_id == run_id for run in readers.listing(store).runs):
        return f"Run {called} has nothing to show here."
    if run_id in manage.trashed(Store(store)):
        return (
            f"Run {called} is in the trash: bring it back on [Compare, under "
            "Runs](/compare?show=Runs)."
        )
    return f"There is no run {called} in this store."


def _open() -> dict[str, list[str]]:
    """What this page's address asked for in vain, by the name in the address."""
    path = urlsplit(st.context.url or "").path
    return st.session_state.setdefault("asked in vain", {}).setdefault(path, {})
