"""Pictures of the studio by a headless Chromium: every page, and animations over a run's fits."""

import io
import shutil
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING
from urllib.parse import urlencode

import numpy as np
from PIL import Image

from app.data import readers
from app.parts import widgets
from app.router import VIEWS
from app.servers.launcher import Studio, servers
from app.theme import Mode
from tom.envs import ROAD
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
FEWEST, FRAMES = 3, 16
"""minimum and maximum number of fits in an animation"""
FRAME_MS, LAST_MS = 600, 2400
WIDTH, HEIGHT = 1280, 800
SHOWN_WIDTHS = (960, 720, 480)
"""tried from the first on"""
LIMIT_BYTES = 2_000_000
"""never exceeded"""
QUALITIES = (80, 60, 40, 20)
WIDTHS = (1280, 1920)
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


@dataclass(frozen=True)
class Capture:
    """A page that shows the fits of a run one after another."""

    view: str
    run_id: str
    steps: tuple[int, ...]

    def addresses(self) -> Iterator[str]:
        """The page's path for every fit."""
        for step in self.steps:
            yield f"{self.view}?{urlencode({'run': self.run_id, 'step': step})}"


def stories(store: Path) -> list[Capture]:
    """The weights of the run with the most fits, and the road-and-rocks run with the most."""
    runs = [run for run in readers.listing(str(store)).runs if widgets.differs(run)]
    captures = []
    for view, steps in (
        ("weights", {r.run_id: readers.profiles(r).env_step for r in runs if r.env != ROAD}),
        ("road", {r.run_id: readers.road_steps(r) for r in runs if r.env == ROAD}),
    ):
        run_id = max(steps, key=lambda name: len(steps[name]), default=None)
        if run_id is not None and len(steps[run_id]) >= FEWEST:
            captures.append(Capture(view, run_id, spread(steps[run_id])))
    return captures


def spread(steps: Sequence[int] | np.ndarray) -> tuple[int, ...]:
    """At most FRAMES evenly spread steps, including the first and the last."""
    index = np.unique(np.linspace(0, len(steps) - 1, FRAMES).round().astype(int))
    return tuple(int(steps[i]) for i in index)


def film(browser: "Browser", address: str, story: Capture, target: Path) -> None:
    """Open the page at every fit and write an animated WebP.

    Raises UserError if it would be too large.
    """
    page = browser.new_page(viewport={"width": WIDTH, "height": HEIGHT}, color_scheme="light")
    frames = []
    for path in story.addresses():
        page.goto(f"{address}/{path}")
        frames.append(Image.open(io.BytesIO(settled_picture(page, whole=False))))
    page.close()
    width, _ = write(frames, target)
    smaller = "" if width == SHOWN_WIDTHS[0] else f": only {width} pixels wide, to stay small"
    print(f"{target}{smaller}", flush=True)


def write(frames: Sequence[Image.Image], target: Path, limit: int = LIMIT_BYTES) -> tuple[int, int]:
    """Write the frames, the last one longer; returns the width and the quality.

    If they take more than `limit` bytes, the quality is reduced, then the size. Raises UserError,
    and writes nothing, if that is not enough.
    """
    size = 0
    for width in SHOWN_WIDTHS:
        small = [_scaled(frame, width) for frame in frames]
        for quality in QUALITIES:
            content = _webp(small, quality)
            if len(content) <= limit:
                target.write_bytes(content)
                return width, quality
            size = len(content)
    raise UserError(
        f"{target.name} would take {size / 1e6:.1f} MB at {SHOWN_WIDTHS[-1]} pixels, and "
        f"{limit / 1e6:.1f} are the most: not written; name a store of other runs (--store)"
    )


def _webp(frames: Sequence[Image.Image], quality: int) -> bytes:
    durations = [FRAME_MS] * (len(frames) - 1) + [LAST_MS]
    content = io.BytesIO()
    frames[0].save(
        content, "WEBP", save_all=True, append_images=list(frames[1:]), duration=durations,
        loop=0, quality=quality, method=4,
    )  # fmt: skip
    return content.getvalue()


def _scaled(frame: Image.Image, width: int) -> Image.Image:
    height = round(frame.height * width / frame.width)
    return frame.convert("RGB").resize((width, height), Image.Resampling.LANCZOS)


def take(store: Path, folder: Path) -> int:
    """Write `<page>-<width>-<mode>.png` for every page into `folder`. Returns 0.

    Also `weights.webp` and `road.webp`, animations over the fits of a run.

    Raises UserError if the browser is missing, or if an animation would be too large.
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
                    page.goto(links.opened(view.PATH))
                    name = view.PATH or "live"
                    target = folder / f"{name}-{width}-{mode}.png"
                    target.write_bytes(compact(settled_picture(page)))
                    print(target, flush=True)
                    page.close()
                context.close()
        for story in stories(store):
            film(browser, links.address, story, folder / f"{story.view}.webp")
    return 0


def compact(picture: bytes) -> bytes:
    """The same picture in 256 colours: a third of the bytes, without visible difference."""
    image = Image.open(io.BytesIO(picture)).convert("RGB")
    small = io.BytesIO()
    image.quantize(256, Image.Quantize.MEDIANCUT).save(small, "PNG", optimize=True)
    return small.getvalue()
