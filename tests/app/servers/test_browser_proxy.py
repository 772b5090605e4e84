"""A visit to a studio behind a reverse proxy: everything below one path of one address."""

import socket
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from socketserver import BaseRequestHandler, ThreadingTCPServer
from threading import Thread
from typing import TYPE_CHECKING

from studio_browser import NEEDS_BROWSER, studio, wait_until_drawn
from studio_runs import PENDULUM_TOM, ROAD_TOM

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

pytestmark = NEEDS_BROWSER
PREFIX = "/user/x/studio"


def pour(source: socket.socket, sink: socket.socket) -> None:
    with suppress(OSError):
        while part := source.recv(1 << 16):
            sink.sendall(part)
        sink.shutdown(socket.SHUT_WR)


@contextmanager
def proxy(port: int) -> Iterator[str]:
    """The address of a proxy in front of `port`, which rewrites nothing."""

    class Carrier(BaseRequestHandler):
        def handle(self) -> None:
            with socket.create_connection(("127.0.0.1", port)) as studio:
                back = Thread(target=pour, args=(studio, self.request), daemon=True)
                back.start()
                pour(self.request, studio)
                back.join()

    with ThreadingTCPServer(("127.0.0.1", 0), Carrier) as server:
        server.daemon_threads = True
        Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_address[1]}{PREFIX}"
        server.shutdown()


def test_a_visit_behind_a_proxy_stays_below_its_path(store: Path, browser: "Browser") -> None:
    with (
        studio(store, browser, base=f"{PREFIX}/") as links,
        proxy(links.port) as address,
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
        page.goto(f"{address}/{links.user_address().removeprefix(f'{links.address}/')}")
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
