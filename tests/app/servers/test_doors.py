"""What pages of other origins can do to a studio in a real browser, and who holds its key."""

from collections.abc import Iterator
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from threading import Thread
from typing import TYPE_CHECKING

import pytest
from studio_browser import NEEDS_BROWSER

from app.links import Links

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

pytestmark = NEEDS_BROWSER
READ = """address => fetch(address).then(answer => answer.text(), () => "refused")"""

FRAME = """address => new Promise(done => {
    const frame = document.createElement("iframe");
    frame.onload = () => done();
    frame.src = address;
    document.body.append(frame);
})"""


class Elsewhere(BaseHTTPRequestHandler):
    """A page of somebody else on this machine, who notes what browsers send along."""

    cookies: list[str]

    def do_GET(self) -> None:
        self.cookies.append(self.headers.get("Cookie", ""))
        self.send_response(200)
        self.send_header("Content-Type", "text/html")
        self.end_headers()
        self.wfile.write(b"<!doctype html><title>elsewhere</title>")

    def log_message(self, format: str, *args: object) -> None:
        """Nothing."""


@contextmanager
def elsewhere() -> Iterator[tuple[int, list[str]]]:
    """Another server of this machine: its port and the cookies that it was sent."""
    cookies: list[str] = []
    handler = type("Noting", (Elsewhere,), {"cookies": cookies})
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        Thread(target=server.serve_forever, daemon=True).start()
        yield server.server_port, cookies
        server.shutdown()


@pytest.fixture
def foreign(links: Links, browser: "Browser") -> Iterator["Page"]:
    """A page of another port, in a browser that has the studio open and holds its key."""
    with elsewhere() as (port, _), browser.new_context() as context:
        context.new_page().goto(links.user_address())
        page = context.new_page()
        page.goto(f"http://127.0.0.1:{port}/")
        yield page


def may_start(page: "Page") -> bool:
    """The page that is open has the form that starts trainings, or says how to get it."""
    page.get_by_text("Start a training").click()
    start = page.get_by_role("button", name="Start", exact=True)
    start.or_(page.get_by_text("open the address that")).first.wait_for(timeout=60_000)
    return start.is_visible()


def test_who_opened_the_printed_address_may_act_and_so_do_their_other_tabs(
    links: Links, browser: "Browser"
) -> None:
    with browser.new_context() as context:
        first, second = context.new_page(), context.new_page()
        first.goto(links.user_address())
        assert may_start(first)
        assert links.key not in first.url
        second.goto(links.address)
        assert may_start(second)


@pytest.mark.parametrize("given", ["", "#key=another", "#key=no <token>"])
def test_another_browser_looks_on(given: str, links: Links, browser: "Browser") -> None:
    with browser.new_context() as context:
        page = context.new_page()
        page.goto(f"{links.address}/{given}")
        assert not may_start(page)


def test_another_port_gets_no_key_from_the_browser(links: Links, browser: "Browser") -> None:
    with elsewhere() as (port, cookies), browser.new_context() as context:
        page = context.new_page()
        page.goto(links.user_address())
        assert may_start(page)
        page.goto(f"http://127.0.0.1:{port}/")
        stored = page.evaluate("JSON.stringify(localStorage) + document.cookie")
        assert links.key not in stored
        assert cookies
        assert all(links.key not in cookie for cookie in cookies)


def test_another_port_reaches_nothing(links: Links, foreign: "Page") -> None:
    for path in ("", "viser/page/", "rerun/", "api/health"):
        assert foreign.evaluate(READ, f"{links.address}/{path}") == "refused"
    for path in ("", "viser/page/", "rerun/"):
        foreign.evaluate(FRAME, f"{links.address}/{path}")
        assert foreign.frames[-1].url == "chrome-error://chromewebdata/", path


@pytest.mark.parametrize("page", ["viser/page/?websocket=ws:", "rerun/?url=http:"])
def test_an_address_that_names_a_foreign_source_for_a_viewer_reaches_none(
    page: str, links: Links, browser: "Browser"
) -> None:
    with elsewhere() as (port, cookies), browser.new_context() as context:
        visit = context.new_page()
        visit.goto(f"{links.address}/{page}//127.0.0.1:{port}/evil")
        visit.locator("canvas").first.wait_for()
        visit.wait_for_timeout(3000)
        assert cookies == []
