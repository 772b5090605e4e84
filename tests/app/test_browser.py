"""The studio in a real browser: its frames really draw, nothing fails, nothing goes outside."""

import io
import shutil
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING
from urllib.parse import parse_qs, urlsplit

import numpy as np
import pytest
from PIL import Image
from studio_runs import PENDULUM_TOM, ROAD_TOM

from app.launcher import Studio, servers
from app.screenshots import chromium
from tom.record.reader import RunReader

if TYPE_CHECKING:
    from playwright.sync_api import ConsoleMessage, Locator, Page

pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(shutil.which("chromium") is None, reason="needs Debian's chromium"),
]
DRAWN_S = 150
LOCAL = {"127.0.0.1", "localhost", ""}


@dataclass
class Visit:
    """A browser tab that remembers what went wrong and where it asked."""

    page: "Page"
    address: str
    errors: list[str] = field(default_factory=list)
    asked: set[str] = field(default_factory=set)

    def __post_init__(self) -> None:
        self.page.on("console", self._said)
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.on("request", lambda request: self._asked(request.url))
        self.page.on("websocket", lambda socket: self._asked(socket.url))

    def open(self, name: str) -> None:
        """Click on a page's name in the studio's menu."""
        self.page.get_by_role("link", name=name).first.click()

    def _said(self, message: "ConsoleMessage") -> None:
        if message.type == "error":
            self.errors.append(message.text)

    def _asked(self, url: str) -> None:
        self.asked.add(urlsplit(url).hostname or "")


@pytest.fixture(scope="module")
def visit(store: Path) -> Iterator[Visit]:
    with servers(Studio(store=store), Event()) as (links, running), chromium() as browser:
        assert running
        page = browser.new_page(viewport={"width": 1280, "height": 1000})
        page.set_default_timeout(1000 * DRAWN_S)
        yield Visit(page, links.address)


def colourful(element: "Locator") -> float:
    """Share of an element's pixels that have a colour (no text, no background)."""
    image = Image.open(io.BytesIO(element.screenshot())).convert("HSV")
    _, saturation, value = np.moveaxis(np.asarray(image), -1, 0)
    return float(((saturation > 90) & (value > 60)).mean())


def wait_until_drawn(element: "Locator", share: float) -> None:
    """Wait until so large a share of the element's pixels is coloured."""
    element.scroll_into_view_if_needed()
    deadline = time.monotonic() + DRAWN_S
    while colourful(element) < share:
        assert time.monotonic() < deadline, f"nothing drawn: {colourful(element):.4f}"
        element.page.wait_for_timeout(500)


def test_a_visit_to_every_page(visit: Visit, store: Path) -> None:
    page = visit.page
    page.goto(f"{visit.address}/?recording={PENDULUM_TOM}")
    page.get_by_text("refreshed every").or_(page.get_by_text("Nothing is training")).wait_for()
    wait_until_drawn(page.locator("iframe"), 0.03)  # Rerun: the robot, the bars, the curves

    visit.open("Compare")
    page.get_by_text("95 % bootstrap").wait_for()
    assert page.locator(".js-plotly-plot").count() == 2

    visit.open("Weights")
    page.get_by_label("Run", exact=True).wait_for()
    chart = page.locator(".js-plotly-plot").first
    chart.locator(".hm").wait_for()
    frame = chart.locator(".nsewdrag").first.bounding_box()
    assert frame is not None
    page.mouse.click(frame["x"] + 0.02 * frame["width"], frame["y"] + 0.5 * frame["height"])
    page.wait_for_url("**/weights?*step=*")
    chosen = int(parse_qs(urlsplit(page.url).query)["step"][0])
    assert chosen == RunReader(store / ROAD_TOM).profiles().env_step[0]
    page.get_by_text(f"The fit at step {chosen:,}").wait_for()

    visit.open("Road and rocks")
    wait_until_drawn(page.locator("iframe"), 0.03)  # viser: columns of weight
    assert visit.errors == []
    assert visit.asked <= LOCAL
