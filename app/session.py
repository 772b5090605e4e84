"""Properties of a page's browser and studio."""

from hmac import compare_digest
from typing import cast
from uuid import uuid4

import streamlit as st

from app.guard import KEY
from app.links import Links
from app.theme import Mode

DRAWN = "drawn"
"""whether a page of this tab has been drawn to its end"""


def links() -> Links:
    """The studio's addresses and its store."""
    return Links.from_environment()


def mode() -> Mode:
    """Light or dark, the mode of this browser's page.

    Until a tab's first page is drawn, Streamlit knows the browser's preference, not the studio's
    own theme (its issue 11920).
    """
    shown, given = st.context.theme.type, links().theme
    if shown not in ("light", "dark") or (given and not st.session_state.get(DRAWN)):
        return given or "light"
    return cast(Mode, shown)


def read_only_reason() -> str:
    """In words, why this browser's pages may not start, stop, weigh and label; empty if they may.

    They may if only this machine can open them and the browser gave the studio's key.
    """
    if not links().local_only:
        return "This studio is open to other machines, so its pages cannot change anything."
    given, key = st.context.headers.get(KEY, ""), links().key
    if not key or not compare_digest(given.encode(), key.encode()):
        return "To change something here, open the address that `tom studio` printed."
    return ""


def client() -> str:
    """The name of this browser tab for the viser server."""
    return st.session_state.setdefault("client", uuid4().hex)
