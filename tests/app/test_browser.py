"""The studio in a real browser: its frames really draw, nothing fails, nothing goes outside."""

import io
import json
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
from studio_runs import PENDULUM_TOM

from app.launcher import Studio, servers
from app.screenshots import chromium
from tom.record.reader import RunReader

if TYPE_CHECKING:
    from playwright.sync_api import ConsoleMessage, Locator, Page

pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(shutil.which("chromium") is None, reason="needs Debian's chromium"),
]
DRAWN_S = 60
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

    def _said(self, message: "ConsoleMessage") -> None:
        if message.type == "error":
            self.errors.append(message.text)

    def _asked(self, url: str) -> None:
        self.asked.add(urlsplit(url).hostname or "")


@pytest.fixture
def own(store: Path, tmp_path: Path) -> Path:
    """A copy of the store that a test may write to."""
    shutil.copytree(store, tmp_path / "store")
    return tmp_path / "store"


@pytest.fixture
def visit(own: Path) -> Iterator[Visit]:
    with servers(Studio(store=own), Event()) as (links, running), chromium() as browser:
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
    chart.page.wait_for_timeout(300)
    after = shown_steps(chart)
    assert before[0] < after[0] < after[1] < before[1]
    return after


def shown_steps(chart: "Locator") -> list[float]:
    return chart.evaluate("plot => plot.layout.xaxis.range.slice()")


def record_another_return(run: Path, step: int) -> None:
    (run / "metrics.parquet").unlink()
    with (run / "metrics.jsonl").open("a") as file:
        file.write(json.dumps({"env_step": step, "eval/return": 1.0}) + "\n")


def test_a_visit_to_every_page(visit: Visit, own: Path) -> None:
    page = visit.page
    page.goto(f"{visit.address}/?recording={PENDULUM_TOM}&runs={PENDULUM_TOM}")
    curve = page.locator(".js-plotly-plot").first
    curve.locator(".nsewdrag").first.wait_for()
    zoomed = zoom_in(curve)
    record_another_return(own / PENDULUM_TOM, 5000)
    page.wait_for_function("plot => plot.calcdata[0].at(-1).x === 5000", arg=curve.element_handle())
    assert shown_steps(curve) == zoomed  # the chart has followed the run and kept the zoom
    wait_until_drawn(page.locator("iframe"), 0.03)  # Rerun: the robot, the bars, the curves

    visit.open("Compare", "compare")
    page.get_by_text("95 % bootstrap").wait_for()
    page.locator(".js-plotly-plot").nth(1).wait_for()

    visit.open("Weights", "weights")
    page.get_by_label("Run", exact=True).wait_for()
    chart = page.locator(".js-plotly-plot").first
    chart.locator(".hm").wait_for()
    frame = chart.locator(".nsewdrag").first.bounding_box()
    assert frame is not None
    page.mouse.click(frame["x"] + 0.02 * frame["width"], frame["y"] + 0.5 * frame["height"])
    page.wait_for_url("**/weights?*step=*")
    chosen = int(parse_qs(urlsplit(page.url).query)["step"][0])
    assert chosen == RunReader(own / PENDULUM_TOM).profiles().env_step[0]
    page.get_by_text(f"The fit at step {chosen:,}").wait_for()

    visit.open("Road and rocks", "road")
    wait_until_drawn(page.locator("iframe"), 0.03)  # viser: columns of weight
    assert visit.errors == []
    assert visit.asked <= LOCAL
