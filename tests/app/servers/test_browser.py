"""The studio in a real browser: its frames really draw, nothing fails, nothing goes outside."""

import io
import shutil
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import parse_qs, urlsplit

import numpy as np
import pandas as pd
import pytest
from PIL import Image
from studio_browser import studio_and_browser
from studio_runs import PENDULUM_TOM, ROAD_TOM, RUNS

from app.links import Links
from tom.record.reader import RunReader

if TYPE_CHECKING:
    from playwright.sync_api import Locator, Page

pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(shutil.which("chromium") is None, reason="needs Debian's chromium"),
]
DRAWN_S = 60
LOCAL = {"127.0.0.1", "localhost", ""}


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


@pytest.fixture
def own(store: Path, tmp_path: Path) -> Path:
    """A copy of the store that a test may write to."""
    shutil.copytree(store, tmp_path / "store")
    return tmp_path / "store"


@pytest.fixture
def visit(own: Path) -> Iterator[Visit]:
    with studio_and_browser(own) as (links, browser):
        page = browser.new_page(viewport={"width": 1280, "height": 1000})
        page.set_default_timeout(1000 * DRAWN_S)
        yield Visit(page, links)


def colourful(element: "Locator", top: float = 1.0) -> float:
    """Share of an element's pixels that have a colour (no text, no background), of its top part."""
    image = np.asarray(Image.open(io.BytesIO(element.screenshot())).convert("HSV"))
    _, saturation, value = np.moveaxis(image[: round(top * len(image))], -1, 0)
    return float(((saturation > 90) & (value > 60)).mean())


def wait_until_drawn(element: "Locator", share: float, top: float = 1.0) -> None:
    """Wait until so large a share of the pixels of the element's top part is coloured."""
    element.scroll_into_view_if_needed()
    deadline = time.monotonic() + DRAWN_S
    while colourful(element, top) < share:
        assert time.monotonic() < deadline, f"nothing drawn: {colourful(element, top):.4f}"
        element.page.wait_for_timeout(500)


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


@pytest.mark.quick
def test_a_visit_to_every_page(visit: Visit, own: Path) -> None:
    page = visit.page
    page.goto(visit.links.opened(f"replays?run={PENDULUM_TOM}&part=Rerun"))
    page.wait_for_url(lambda address: "key" not in address)
    wait_until_drawn(page.locator("iframe").last, 0.03)  # Rerun: the robot, the bars, the curves

    visit.open("Answer", "")
    page.get_by_text("Does it help?").wait_for()
    visit.open("Curves", "curves")
    page.locator(".js-plotly-plot").nth(1).wait_for()
    take_the_table(page)
    visit.open("Attention", "attention")
    click_the_first_fit(page, own)
    lasso_a_region(page)
    page.get_by_role("radio", name="Every learner on one buffer").click()
    page.get_by_role("button", name="Weigh", exact=True).wait_for()
    visit.open("Replays", "replays")
    play_an_episode(page)
    see_it_in_rerun(page)
    visit.open("Findings", "findings")
    page.get_by_text("tom reproduce").first.wait_for()
    page.goto(f"{visit.links.address}/road?run={ROAD_TOM}")  # as older studios had it
    wait_until_drawn(page.locator("iframe").first, 0.03)  # viser: columns of weight
    keep_the_chosen_run(visit)
    follow_a_short_link(visit)
    assert visit.asked <= LOCAL


def take_the_table(page: "Page") -> None:
    with page.expect_download() as download:
        page.get_by_role("button", name="Single runs").click()
    table = pd.read_csv(download.value.path())
    assert set(table["run"]) == {run_id for run_id, env, *_ in RUNS if env == "inverted-pendulum"}


def click_the_first_fit(page: "Page", store: Path) -> None:
    chart = page.locator(".js-plotly-plot").first
    chart.locator(".hm").wait_for()
    frame = chart.locator(".nsewdrag").first.bounding_box()
    assert frame is not None
    page.mouse.click(frame["x"] + 0.02 * frame["width"], frame["y"] + 0.5 * frame["height"])
    page.wait_for_url("**/attention?*step=*")
    chosen = int(asked(page)["step"][0])
    assert chosen == RunReader(store / PENDULUM_TOM).profiles().env_step[0]
    page.locator(".readout dd").first.get_by_text(f"{chosen:,}", exact=True).wait_for()


def keep_the_chosen_run(visit: Visit) -> None:
    """Another page shows the run that was chosen on this one."""
    visit.open("Replays", "replays")
    visit.page.wait_for_url(f"**/replays?*run={ROAD_TOM}*")


def lasso_a_region(page: "Page") -> None:
    """A lasso chooses rows in the browser, and then on the server."""
    page.locator(".buffer-map[data-drawn]").wait_for()
    page.locator(".map-over").evaluate("map => map.scrollIntoView({ block: 'center' })")
    frame = page.locator(".map-over").bounding_box()
    assert frame is not None
    corners = [(0.3, 0.3), (0.7, 0.3), (0.7, 0.7), (0.3, 0.7), (0.3, 0.35)]
    places = [(frame["x"] + a * frame["width"], frame["y"] + b * frame["height"])
              for a, b in corners]  # fmt: skip
    page.mouse.move(*places[0])
    page.mouse.down()
    for place in places[1:]:
        page.mouse.move(*place, steps=4)
    page.mouse.up()
    page.wait_for_url("**/attention?*outline=*")
    inside = page.evaluate("Number(document.querySelector('.buffer-map').dataset.rows)")
    assert inside > 0
    page.get_by_role("button", name=f"Fit small models: {inside:,} transitions").wait_for()


def play_an_episode(page: "Page") -> None:
    """The scene's clock moves the cursor of the charts, once somebody has said that it shall."""
    wait_until_drawn(page.locator("iframe"), 0.001)
    cursor = "plot => plot.layout.shapes[0].x0"
    chart = page.locator(".js-plotly-plot").nth(1)
    chart.locator(".nsewdrag").first.wait_for()
    before = chart.evaluate(cursor)
    page.locator(".st-key-replay-play button").click()
    deadline = time.monotonic() + DRAWN_S
    while chart.evaluate(cursor) == before:
        assert time.monotonic() < deadline, f"the replay stands at {before}"
        page.wait_for_timeout(200)


def see_it_in_rerun(page: "Page") -> None:
    """The same episode, made into a recording when it is asked for."""
    with page.expect_response("**/episode-*.rrd") as answer:
        page.get_by_role("radio", name="Rerun").last.click()
    assert answer.value.ok
    # Only the scene: the viewer's buttons and its curve are coloured without any robot.
    wait_until_drawn(page.locator("iframe"), 0.002, top=0.65)


def follow_a_short_link(visit: Visit) -> None:
    """Who opens it sees the same."""
    page = visit.page
    page.goto(f"{visit.links.address}/compare?env=inverted-pendulum&logy=true")
    page.get_by_text("1000 resamples").wait_for()
    page.get_by_role("button", name="Link").click()
    page.get_by_role("button", name="Make a short link").click()
    link = page.get_by_text("/v/").first
    link.wait_for()
    page.goto(link.inner_text())
    drawn(page)
    assert asked(page) == {"task": ["inverted-pendulum"], "logy": ["true"]}
    page.get_by_role("button", name="Lines", exact=True).click()
    assert page.get_by_role("switch", name="log y").is_checked()
