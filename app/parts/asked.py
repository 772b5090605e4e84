"""Messages about runs that an address names but that do not exist."""

from collections.abc import Collection
from urllib.parse import urlsplit

import streamlit as st

from app import session, text
from app.data import readers
from app.parts import address

LONGEST = 120
"""number of characters shown of an id, which may be any text"""


def tell(name: str, there: Collection[str]) -> None:
    """Show a message on the runs in the address (`name=`) that are not among `there`.

    Must be called before the widget of that name is made, which drops them from the address. The
    message stays until the user chooses there (`answered`).
    """
    # Only what the user came with: a run may also leave a page that follows what happens.
    unknown = [run_id for run_id in address.requested(name) or [] if run_id not in there]
    if unknown:
        _open()[name] = unknown
    for run_id in _open().get(name, ()):
        st.warning(f"{why(run_id)} Something else is shown.", icon=":material/link_off:")


def answered(name: str) -> None:
    """Remove the message, because the user has chosen."""
    _open().pop(name, None)


def why(run_id: str) -> str:
    """Where to find a run that a page does not show, in Markdown."""
    store = session.links().store
    called = text.markdown(run_id[:LONGEST])
    if any(run.run_id == run_id for run in readers.listing(store).runs):
        return f"Run {called} has nothing to show here."
    if run_id in readers.trashed(store):
        return (
            f"Run {called} is in the trash: bring it back on [Compare, under "
            "Runs](/compare?show=Runs)."
        )
    return f"There is no run {called} in this store."


def _open() -> dict[str, list[str]]:
    """The missing runs of this page's address, by parameter."""
    path = urlsplit(st.context.url or "").path
    return st.session_state.setdefault("asked in vain", {}).setdefault(path, {})
