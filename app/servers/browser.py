"""Pictures of the studio by a headless Chromium: every page, and animations over a run's fits."""

import io
import shutil
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING
from urllib.parse import urlencode

from PIL import Image

from app.data import readers, road
from app.links import Links
from app.parts import widgets
from app.servers.launcher import serving
from app.theme import Mode
from tom.envs import ROAD
from tom.errors import UserError
from tom.spread import spread

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Page, ViewportSize

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
    # Reading a canvas back from the software renderer takes 0.3 s a picture, from memory 0.01 s.
    "--disable-accelerated-2d-canvas",
    "--ignore-gpu-blocklist",
    "--disable-quic",
    "--no-first-run",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
)
FEWEST, FRAMES = 3, 16
"""minimum and maximum number of fits in an animation"""
DURATIONS_MS = 600, 2400
"""of a frame, and of the last one"""
ANIMATED: "ViewportSize" = {"width": 1280, "height": 800}
SHOWN_WIDTHS = (960, 720, 480)
"""tried from the first on"""
LIMIT_BYTES = 2_000_000
"""never exceeded"""
QUALITIES = (80, 60, 40, 20)
WIDTHS = (1280, 1920)
SHOWN = {
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


def settled_picture(page: "Page", *, whole: bool = True) -> bytes:
    """A screenshot of the whole page, or of its visible part, once it has stopped changing."""
    page.set_default_timeout(PATIENCE_MS)
    page.wait_for_selector('[data-testid="stMainBlockContainer"]')
    page.wait_for_timeout(3000)
    deadline = time.monotonic() + SETTLE_S
    before, now = b"", page.screenshot()
    while (before != now or not page.evaluate(DRAWN)) and time.monotonic() < deadline:
        if whole:  # the window as high as the page, which scrolls inside a frame
            height = page.evaluate("document.querySelector('[data-testid=stMain]').scrollHeight")
            width = (page.viewport_size or ANIMATED)["width"]
            page.set_viewport_size({"width": width, "height": max(int(height), 600)})
        for frame in page.frames:  # viser's note on software rendering, only in a headless browser
            for button in frame.locator(".mantine-Notification-closeButton").all():
                button.dispatch_event("click")
        page.wait_for_timeout(2500)
        before, now = now, page.screenshot()
    return now


def stories(store: Path) -> list[tuple[str, str, list[int]]]:
    """The run with the most fits and the road-and-rocks run with the most: name, run id, steps."""
    runs = [run for run in readers.listing(str(store)).runs if widgets.differs(run)]
    fits = {r.run_id: list(readers.profiles(r).env_step) for r in runs if r.env != ROAD}
    maps = {r.run_id: road.steps(r) for r in runs if r.env == ROAD}
    found = []
    for name, steps in (("attention", fits), ("road", maps)):
        run_id = max(steps, key=lambda run_id: len(steps[run_id]), default=None)
        if run_id is not None and len(steps[run_id]) >= FEWEST:
            shown = spread(len(steps[run_id]), FRAMES)
            found.append((name, run_id, [int(steps[run_id][i]) for i in shown]))
    return found


def animation(
    frames: Sequence[Image.Image],
    widths: Sequence[int],
    qualities: Sequence[int],
    durations: tuple[int, int],
    limit: int = LIMIT_BYTES,
) -> bytes:
    """The frames as a WebP of at most `limit` bytes; `durations`: of a frame and of the last, ms.

    If they take more, the next lower quality is tried, then the next smaller width. Raises
    UserError if that is not enough.
    """
    each, last = durations
    content = io.BytesIO()
    for width in widths:
        small = [scaled(frame, width) for frame in frames]
        for quality in qualities:
            content = io.BytesIO()
            small[0].save(
                content, "WEBP", save_all=True, append_images=small[1:], loop=0, quality=quality,
                duration=[each] * (len(frames) - 1) + [last], method=4,
            )  # fmt: skip
            if content.tell() <= limit:
                return content.getvalue()
    raise UserError(
        f"the animation would take {content.tell() / 1e6:.1f} MB, and {limit / 1e6:g} are the most:"
        " not written; name another run, or a store of other runs (--store)"
    )


def scaled(frame: Image.Image, width: int) -> Image.Image:
    height = round(frame.height * width / frame.width)
    return frame.convert("RGB").resize((width, height), Image.Resampling.LANCZOS)


def take(store: Path, folder: Path) -> int:
    """Write `<name>-<width>-<mode>.png` of `SHOWN` into `folder`. Returns 0.

    Also `attention.webp` and `road.webp`, animations over the fits of a run.

    Raises UserError if the browser is missing, or if an animation would be too large.
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
                for name, (path, choices) in SHOWN.items():
                    page = context.new_page()
                    page.goto(links.opened(f"{path}?{urlencode(choices)}".removesuffix("?")))
                    target = folder / f"{name}-{width}-{mode}.png"
                    target.write_bytes(compact(settled_picture(page)))
                    print(target, flush=True)
                    page.close()
                context.close()
        for name, run_id, steps in stories(store):
            page = browser.new_page(viewport=ANIMATED, color_scheme="light")
            frames = []
            for step in steps:
                page.goto(f"{links.address}/attention?{urlencode({'run': run_id, 'step': step})}")
                frames.append(Image.open(io.BytesIO(settled_picture(page, whole=False))))
            page.close()
            target = folder / f"{name}.webp"
            target.write_bytes(animation(frames, SHOWN_WIDTHS, QUALITIES, DURATIONS_MS))
            print(target, flush=True)
    return 0


def compact(picture: bytes) -> bytes:
    """The same picture in 256 colours: a third of the bytes, without visible difference."""
    image = Image.open(io.BytesIO(picture)).convert("RGB")
    small = io.BytesIO()
    # The rare colours of thin lines are kept, and the means of the common ones are exact.
    image.quantize(256, Image.Quantize.MAXCOVERAGE, kmeans=1).save(small, "PNG", optimize=True)
    return small.getvalue()
