"""A studio of this machine and a browser beside it."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING

import pytest

from app.links import Links
from app.servers.browser import chromium
from app.servers.launcher import Studio, serving

if TYPE_CHECKING:
    from playwright.sync_api import Browser, BrowserContext, ConsoleMessage, Page, WebError


@contextmanager
def studio_and_browser(store: Path, base: str = "") -> Iterator[tuple[Links, "Browser"]]:
    """The studio of `store` with all its servers, and a browser that has not opened it yet.

    Fails at the end if a page of the studio, or a file saved from it, had an error.
    """
    errors: list[str] = []
    with serving(Studio(store, base=base), Event()) as (links, running), chromium() as browser:

        def note(page: "Page | None", error: str) -> None:
            if page is None or page.url.startswith((links.address, "file:")):
                errors.append(f"{page and page.url}: {error}")

        def failed(error: "WebError") -> None:
            note(error.page, str(error.error))

        def said(message: "ConsoleMessage") -> None:
            at = message.location["url"]
            # A page that a test asks for although it is not there.
            absent = (
                message.text.startswith("Failed to load")
                and message.page
                and message.page.url == at
            )
            if message.type == "error" and not absent:
                note(message.page, f"{message.text} ({at})")

        def watch(context: "BrowserContext") -> None:
            context.on("weberror", failed)
            context.on("console", said)

        assert running
        browser.on("context", watch)
        yield links, browser
    if errors:
        pytest.fail("\n".join(errors))
