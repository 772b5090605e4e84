"""A studio of this machine, a browser beside it, and what a visitor does in it."""

import io
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING
from urllib.parse import parse_qs, urlsplit

import numpy as np
import pytest
from PIL import Image

from app.links import Links
from app.servers.launcher import serving

if TYPE_CHECKING:
    from playwright.sync_api import (
        Browser,
        BrowserContext,
        ConsoleMessage,
        Locator,
        Page,
        WebError,
    )

NEEDS_BROWSER = [
    pytest.mark.browser,
    pytest.mark.skipif(shutil.which("chromium") is None, reason="needs Debian's chromium"),
]
DRAWN_S = 60
LOCAL = {"127.0.0.1", "localhost", ""}
"""where a page of the studio may ask"""
CALM = """() => new Promise(resolve => {
    let timer = setTimeout(resolve, 500);
    new MutationObserver(() => {
        clearTimeout(timer);
        timer = setTimeout(resolve, 500);
    }).observe(document.body, { subtree: true, childList: true });
})"""
"""waits until half a second has passed without a change of the page: a box that is drawn again
drops what was typed"""


@dataclass
class Visit:
    """A browser tab that remembers where it asked."""

    page: "Page"
    links: Links
    asked: set[str] = field(default_factory=set)

    def __post_init__(self) -> None:
        self.page.on("request", lambda request: self._asked(request.url))
        self.page.on("websocket", lambda socket: self._asked(socket.url))

    def open(self, name: str, path: str) -> None:
        """Click on a page's name in the studio's menu, again if the click fell into a redraw."""
        from playwright.sync_api import TimeoutError

        for _ in range(4):
            self.page.get_by_role("link", name=name).first.click()
            try:
                self.page.wait_for_url(f"**/{path}*", timeout=10_000)
                return
            except TimeoutError:
                continue
        pytest.fail(f"{name} did not open")

    def _asked(self, url: str) -> None:
        self.asked.add(urlsplit(url).hostname or "")


def colourful(element: "Locator", top: float = 1.0) -> float:
    """Share of an element's pixels that have a colour (no text, no background), of its top part."""
    image = np.asarray(Image.open(io.BytesIO(element.screenshot())).convert("HSV"))
    _, saturation, value = np.moveaxis(image[: round(top * len(image))], -1, 0)
    return float(((saturation > 90) & (value > 60)).mean())


def wait_until_drawn(element: "Locator", share: float, top: float = 1.0) -> None:
    """Wait until so large a share of the pixels of the element's top part is coloured."""
    element.scroll_into_view_if_needed()
    until(element.page, lambda: colourful(element, top) >= share, "nothing drawn")


def wait_until_steady(page: "Page", true: Callable[[], bool], seconds: float) -> None:
    """Wait until something has been true for `seconds` without a break."""
    deadline = time.monotonic() + DRAWN_S
    since = time.monotonic()
    while time.monotonic() - since < seconds:
        assert time.monotonic() < deadline, "the page does not come to rest so"
        page.wait_for_timeout(100)
        if not true():
            since = time.monotonic()


def zoom_in(chart: "Locator") -> list[float]:
    """Drag a box over a chart; the range of steps that it shows then."""
    before = shown_steps(chart)
    box = chart.locator(".nsewdrag").first.bounding_box()
    assert box is not None
    mouse = chart.page.mouse
    mouse.move(box["x"] + 0.3 * box["width"], box["y"] + 0.2 * box["height"])
    mouse.down()
    mouse.move(box["x"] + 0.7 * box["width"], box["y"] + 0.8 * box["height"], steps=5)
    mouse.up()
    wait_until_steady(chart.page, lambda: shown_steps(chart) != before, 0.3)
    after = shown_steps(chart)
    assert before[0] < after[0] < after[1] < before[1]
    return after


def shown_steps(chart: "Locator") -> list[float]:
    return chart.evaluate("plot => plot.layout.xaxis.range.slice()")


def drawn(page: "Page") -> "Locator":
    """The page's first chart, once it is there."""
    found = page.locator(".js-plotly-plot").first
    found.locator(".nsewdrag").first.wait_for()
    return found


def named(page: "Page") -> list[str]:
    """The names of what the page's first chart draws."""
    names = "plot => (plot._fullData ?? []).filter(t => t.visible === true).map(t => t.name ?? '')"
    return drawn(page).evaluate(names)


def lines(page: "Page") -> set[str]:
    """The groups that have a line in the page's first chart, by the first word of their title."""
    return {word for name in named(page) if (word := name.partition(" ")[0]).isupper()}


def asked(page: "Page") -> dict[str, list[str]]:
    return parse_qs(urlsplit(page.url).query)


def settle(page: "Page", words: str) -> None:
    page.wait_for_url(lambda address: words in address)
    page.wait_for_timeout(1500)  # no drawing is under way, so that the next one is another entry


def choose(page: "Page", label: str, option: str) -> None:
    """Take an option of a select box or multiselect, again if the click fell into a redraw."""
    from playwright.sync_api import TimeoutError

    for _ in range(4):
        page.get_by_role("combobox", name=label).first.click()
        try:
            page.get_by_role("option", name=option, exact=True).first.click(timeout=10_000)
            return
        except TimeoutError:
            page.keyboard.press("Escape")
    pytest.fail(f"{option} of {label} could not be taken")


def until(page: "Page", holds, what: str) -> None:
    """Wait until something holds that no element of the page tells."""
    deadline = time.monotonic() + DRAWN_S
    while not holds():
        assert time.monotonic() < deadline, what
        page.wait_for_timeout(200)


@contextmanager
def studio(store: Path, browser: "Browser", base: str = "") -> Iterator[Links]:
    """The studio of `store` with all its servers, which the browser has not opened yet.

    Fails at the end if a page of the studio, or a file saved from it, had an error.
    """
    errors: list[str] = []
    with serving(Links(str(store), base=base), Event()) as (links, running):

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
        yield links
        browser.remove_listener("context", watch)
    if errors:
        pytest.fail("\n".join(errors))
