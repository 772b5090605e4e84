"""A visit to a studio behind a reverse proxy: everything below one path of one address."""

from pathlib import Path
from typing import TYPE_CHECKING

from reverse_proxy import reverse_proxy
from studio_browser import NEEDS_BROWSER, studio_and_browser, wait_until_drawn
from studio_runs import PENDULUM_TOM, ROAD_TOM

if TYPE_CHECKING:
    from playwright.sync_api import Page

pytestmark = NEEDS_BROWSER
PREFIX = "/user/x/studio"


def test_a_visit_behind_a_proxy_stays_below_its_path(store: Path) -> None:
    with (
        studio_and_browser(store, base=f"{PREFIX}/") as (links, browser),
        reverse_proxy(PREFIX, links.port) as address,
    ):
        page = browser.new_page(viewport={"width": 1280, "height": 1000})
        page.set_default_timeout(60_000)
        asked: list[str] = []
        errors: list[str] = []
        page.context.on("request", lambda request: asked.append(request.url))
        page.on("websocket", lambda socket: asked.append(socket.url.replace("ws:", "http:")))
        page.context.on("weberror", lambda error: errors.append(str(error.error)))
        page.context.on(
            "console", lambda said: errors.append(said.text) if said.type == "error" else None
        )
        page.goto(f"{address}/{links.opened().removeprefix(f'{links.address}/')}")
        page.get_by_text("Does it help?").wait_for()
        page.get_by_text("Start a training").click()  # the key has come along
        page.get_by_role("button", name="Start", exact=True).wait_for()
        to(page, "Curves").locator(".js-plotly-plot").nth(1).wait_for()
        to(page, "Attention").locator(".js-plotly-plot .hm").first.wait_for()
        page.locator(".buffer-map[data-drawn]").wait_for()
        page.goto(f"{address}/replays?run={PENDULUM_TOM}")
        wait_until_drawn(page.locator("iframe"), 0.002, top=0.65)  # viser
        page.get_by_role("radio", name="Rerun", exact=True).last.click()
        wait_until_drawn(page.locator("iframe"), 0.01)
        page.goto(f"{address}/road?run={ROAD_TOM}")  # as older studios had it
        page.wait_for_url(f"{address}/attention?**")
        page.close()
        assert [url for url in asked if not url.startswith(("data:", "blob:", f"{address}/"))] == []
        assert errors == []


def to(page: "Page", name: str) -> "Page":
    page.get_by_role("link", name=name).first.click()
    return page
