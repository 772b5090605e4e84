"""What a page needs to know about its browser and its studio."""

from hmac import compare_digest
from typing import cast
from urllib.parse import urlsplit
from uuid import uuid4

import streamlit as st

from app.guard import KEY
from app.links import Links
from app.theme import Mode
from tom.machine.address import in_url


def links() -> Links:
    """The studio's addresses and its store."""
    return Links.from_environment()


def mode() -> Mode:
    """Light or dark, as this browser shows the page."""
    shown = st.context.theme.type
    return cast(Mode, shown) if shown in ("light", "dark") else links().theme or "light"


def host() -> str:
    """The host by which this browser reaches the studio; its other servers are there too."""
    return in_url(urlsplit(st.context.url or "").hostname or links().local_host)


def may_act() -> bool:
    """Pages may start, stop, weigh and label: see `looks_on`."""
    return not looks_on()


def looks_on() -> str:
    """Why this browser's pages change nothing, in words; empty where they may act.

    They may where nobody but this machine can open them and the browser gave the studio's key.
    """
    if not links().local_only:
        return "This studio is open to other machines, so its pages change nothing."
    given, key = st.context.headers.get(KEY, ""), links().key
    if not key or not compare_digest(given.encode(), key.encode()):
        return "To change something here, open the address that `tom studio` printed."
    return ""


def client() -> str:
    """A name for this browser tab, under which its viser frame is known to the viser server."""
    return st.session_state.setdefault("client", uuid4().hex)
