"""Pictures of every page, as a reader sees them: headless Chromium on the studio itself."""

import io
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING

from PIL import Image

from app.launcher import Studio, servers
from app.router import VIEWS
from app.theme import Mode
from tom.errors import UserError

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

WIDTHS = (1280, 1920)
MODES: tuple[Mode, ...] = ("light", "dark")
SETTLE_S = 45.0
"""how long a page may take until its picture stands still (3D is drawn in software)"""
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


def take(store: Path, folder: Path) -> int:
    """Write `<page>-<width>-<mode>.png` for every page into `folder`. Returns 0.

    Raises UserError where the browser is missing.
    """
    with servers(Studio(store=store), Event()) as (links, running), chromium() as browser:
        if running is None:
            return 1
        folder.mkdir(parents=True, exist_ok=True)
        for mode in MODES:
            for width in WIDTHS:
                context = browser.new_context(
                    viewport={"width": width, "height": 900}, color_scheme=mode
                )
                for view in VIEWS:
                    page = context.new_page()
                    page.goto(f"{links.address}/{view.PATH}")
                    name = view.PATH or "live"
                    target = folder / f"{name}-{width}-{mode}.png"
                    target.write_bytes(compact(settled_picture(page)))
                    print(target, flush=True)
                    page.close()
                context.close()
    return 0


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


def settled_picture(page: "Page") -> bytes:
    """The whole page once it has stopped changing."""
    page.wait_for_selector('[data-testid="stMainBlockContainer"]')
    page.wait_for_timeout(3000)
    deadline = time.monotonic() + SETTLE_S
    before, now = b"", page.screenshot()
    while before != now and time.monotonic() < deadline:
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


def compact(picture: bytes) -> bytes:
    """The same picture in 256 colours: a third of the bytes, no difference to the eye."""
    image = Image.open(io.BytesIO(picture)).convert("RGB")
    small = io.BytesIO()
    image.quantize(256, Image.Quantize.MEDIANCUT).save(small, "PNG", optimize=True)
    return small.getvalue()


def _grow(page: "Page") -> None:
    """Make the window as high as the page, which scrolls inside a frame of its own."""
    height = page.evaluate("document.querySelector('[data-testid=stMain]').scrollHeight")
    size = page.viewport_size or {"width": WIDTHS[0], "height": 900}
    page.set_viewport_size({"width": size["width"], "height": max(int(height), 600)})
