"""What a page needs to know about its browser and its studio."""

from typing import cast
from urllib.parse import urlsplit
from uuid import uuid4

import streamlit as st

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
    """Pages may start, stop and label runs: only where nobody but this machine can open them."""
    return links().local_only


def client() -> str:
    """A name for this browser tab, under which its viser frame is known to the viser server."""
    return st.session_state.setdefault("client", uuid4().hex)
