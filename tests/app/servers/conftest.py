"""One browser a module, and one studio for those visits of it that change no run."""

from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from studio_browser import DRAWN_S, Visit, studio

from app.links import Links
from app.servers.browser import chromium

if TYPE_CHECKING:
    from playwright.sync_api import Browser


@pytest.fixture(scope="module")
def browser() -> Iterator["Browser"]:
    with chromium() as browser:
        yield browser


@pytest.fixture(scope="module")
def links(store: Path, browser: "Browser") -> Iterator[Links]:
    with studio(store, browser) as links:
        yield links


@pytest.fixture
def visit(links: Links, browser: "Browser") -> Iterator[Visit]:
    """A tab whose visitor changes no run."""
    yield from _tab(links, browser)


@pytest.fixture
def visit_own(own: Path, browser: "Browser") -> Iterator[Visit]:
    """A tab of a studio of its own, whose runs it may change."""
    with studio(own, browser) as links:
        yield from _tab(links, browser)


def _tab(links: Links, browser: "Browser") -> Iterator[Visit]:
    with closing(browser.new_page(viewport={"width": 1280, "height": 1000})) as page:
        page.set_default_timeout(1000 * DRAWN_S)
        yield Visit(page, links)
