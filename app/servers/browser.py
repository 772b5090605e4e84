"""A headless Chromium on this machine, and its screenshots."""

import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from tom.errors import UserError

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

SETTLE_S = 45.0
"""time limit until a page's picture is stable (3D is rendered in software)"""
PATIENCE_MS = 180_000
"""time limit of a screenshot, long because the machine may be training"""
DRAWN = """[...document.querySelectorAll(".plot")].every(
    (plot) => plot.parentElement.querySelector(".main-svg, .plot-failed:not([hidden])")
)"""
"""whether every chart is there, or its error message"""
CHROMIUM_FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    "--ignore-gpu-blocklist",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)


@contextmanager
def chromium() -> Iterator["Browser"]:
    """A headless Chromium on this machine. Raises UserError if there is none."""
    path = shutil.which("chromium") or shutil.which("chromium-browser")
    if path is None:
        raise UserError("this needs Chromium: install it (apt-get install chromium)")
    try:
        from playwright.sync_api import sync_playwright
    except ImportError as error:
        raise UserError("this needs playwright: pip install -e '.[test]'") from error
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=list(CHROMIUM_FLAGS))
        try:
            yield browser
        finally:
            browser.close()


def settled_picture(page: "Page", *, whole: bool = True) -> bytes:
    """A screenshot of the whole page, or of its visible part, once it has stopped changing."""
    page.set_default_timeout(PATIENCE_MS)
    page.wait_for_selector('[data-testid="stMainBlockContainer"]')
    page.wait_for_timeout(3000)
    deadline = time.monotonic() + SETTLE_S
    before, now = b"", page.screenshot()
    while (before != now or not page.evaluate(DRAWN)) and time.monotonic() < deadline:
        if whole:
            _grow(page)
        _close_notes(page)
        page.wait_for_timeout(2500)
        before, now = now, page.screenshot()
    return now


def _close_notes(page: "Page") -> None:
    """Close viser's note on software rendering, which appears only in a headless browser."""
    for frame in page.frames:
        for button in frame.locator(".mantine-Notification-closeButton").all():
            button.dispatch_event("click")


def _grow(page: "Page") -> None:
    """Make the window as high as the page, which scrolls inside a frame."""
    height = page.evaluate("document.querySelector('[data-testid=stMain]').scrollHeight")
    size = page.viewport_size or {"width": 1280, "height": 900}
    page.set_viewport_size({"width": size["width"], "height": max(int(height), 600)})
