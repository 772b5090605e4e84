"""A headless Chromium of this machine, and pictures of what it shows."""

import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from tom.errors import UserError

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

SETTLE_S = 45.0
"""how long a page may take until its picture stands still (3D is drawn in software)"""
PATIENCE_MS = 180_000
"""a machine that trains at the same time takes its time for a picture"""
DRAWN = """[...document.querySelectorAll(".plot")].every(
    (plot) => plot.querySelector(".main-svg, .failed")
)"""
"""every chart is there, or says why it is not"""
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
    """A headless Chromium of this machine. Raises UserError where there is none."""
    path = shutil.which("chromium") or shutil.which("chromium-browser")
    if path is None:
        raise UserError("--screenshots needs Chromium: install it (apt-get install chromium)")
    try:
        from playwright.sync_api import sync_playwright
    except ImportError as error:
        raise UserError("--screenshots needs playwright: pip install -e '.[test]'") from error
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=path, args=list(CHROMIUM_FLAGS))
        try:
            yield browser
        finally:
            browser.close()


def settled_picture(page: "Page", *, whole: bool = True) -> bytes:
    """The whole page, or what is seen of it without scrolling, once it has stopped changing."""
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
    """Close viser's note that 3D is drawn in software, which is so in a headless browser only."""
    for frame in page.frames:
        for button in frame.locator(".mantine-Notification-closeButton").all():
            button.click()


def _grow(page: "Page") -> None:
    """Make the window as high as the page, which scrolls inside a frame of its own."""
    height = page.evaluate("document.querySelector('[data-testid=stMain]').scrollHeight")
    size = page.viewport_size or {"width": 1280, "height": 900}
    page.set_viewport_size({"width": size["width"], "height": max(int(height), 600)})
