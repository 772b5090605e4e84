"""Pictures of the studio's pages by a headless Chromium."""

import io
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING
from urllib.parse import urlencode

from PIL import Image

from app.links import Links
from app.servers.launcher import serving
from app.theme import Mode
from tom.envs import ROAD
from tom.errors import UserError

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page

SETTLE_S = 45.0
"""time limit until a page's picture is stable (3D is rendered in software)"""
PATIENCE_MS = 180_000
"""time limit of a screenshot, long because the machine may be training"""
CHARTS_DRAWN = """[...document.querySelectorAll(".plot")].every(
    (plot) => plot.parentElement.querySelector(".main-svg, .plot-failed:not([hidden])")
)"""
"""whether every chart is there, or its error message"""
CHROMIUM_FLAGS = (
    "--headless=new",
    "--no-sandbox",
    "--use-angle=swiftshader",
    "--enable-unsafe-swiftshader",
    # Reading a canvas back from the software renderer takes 0.3 s a picture, from memory 0.01 s.
    "--disable-accelerated-2d-canvas",
    "--ignore-gpu-blocklist",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)
WIDTHS = (1280, 1920)
PAGES = {
    "answer": ("", {}),
    "curves": ("curves", {}),
    "attention": ("attention", {}),
    "attention-buffer": ("attention", {"where": "weight rank 99.."}),
    "attention-learners": ("attention", {"part": "Every learner on one buffer"}),
    "attention-road": ("attention", {"task": ROAD}),
    "replays": ("replays", {}),
    "film": ("replays", {"part": "Film"}),
    "findings": ("findings", {}),
}
"""the pictures of pages: the page and its choices"""
MODES: tuple[Mode, ...] = ("light", "dark")


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


def stable_screenshot(page: "Page") -> bytes:
    """A screenshot of the whole page, once it has stopped changing."""
    page.set_default_timeout(PATIENCE_MS)
    page.wait_for_selector('[data-testid="stMainBlockContainer"]')
    page.wait_for_timeout(3000)
    deadline = time.monotonic() + SETTLE_S
    before, now = b"", page.screenshot()
    while (before != now or not page.evaluate(CHARTS_DRAWN)) and time.monotonic() < deadline:
        # The window is as high as the page, which scrolls inside a frame.
        height = page.evaluate("document.querySelector('[data-testid=stMain]').scrollHeight")
        width = page.evaluate("innerWidth")
        page.set_viewport_size({"width": width, "height": max(int(height), 600)})
        for frame in page.frames:  # viser's note on software rendering, only in a headless browser
            for button in frame.locator(".mantine-Notification-closeButton").all():
                button.dispatch_event("click")
        page.wait_for_timeout(2500)
        before, now = now, page.screenshot()
    return now


def take_pictures(store: Path, folder: Path) -> int:
    """Write `<name>-<width>-<mode>.png` of `SHOWN` into `folder`. Returns 0.

    Raises UserError if the browser is missing.
    """
    with serving(Links(str(store)), Event()) as (links, running), chromium() as browser:
        if running is None:
            return 1
        folder.mkdir(parents=True, exist_ok=True)
        for mode in MODES:
            for width in WIDTHS:
                context = browser.new_context(
                    viewport={"width": width, "height": 900}, color_scheme=mode
                )
                for name, (path, choices) in PAGES.items():
                    page = context.new_page()
                    page.goto(links.user_address(f"{path}?{urlencode(choices)}".removesuffix("?")))
                    target = folder / f"{name}-{width}-{mode}.png"
                    target.write_bytes(to_256_colours(stable_screenshot(page)))
                    print(target, flush=True)
                    page.close()
                context.close()
    return 0


def to_256_colours(picture: bytes) -> bytes:
    """The same picture in 256 colours: a third of the bytes, without visible difference."""
    image = Image.open(io.BytesIO(picture)).convert("RGB")
    small = io.BytesIO()
    # The rare colours of thin lines are kept, and the means of the common ones are exact.
    image.quantize(256, Image.Quantize.MAXCOVERAGE, kmeans=1).save(small, "PNG", optimize=True)
    return small.getvalue()
