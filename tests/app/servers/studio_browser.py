"""A studio of this machine and a browser beside it."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING

from app.links import Links
from app.servers.browser import chromium
from app.servers.launcher import Studio, servers

if TYPE_CHECKING:
    from playwright.sync_api import Browser


@contextmanager
def studio_and_browser(store: Path) -> Iterator[tuple[Links, "Browser"]]:
    """The studio of `store` with all its servers, and a browser that has not opened it yet."""
    with servers(Studio(store=store), Event()) as (links, running), chromium() as browser:
        assert running
        yield links, browser
