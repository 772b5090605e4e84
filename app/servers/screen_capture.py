"""Screen captures: an animation of a page that steps through a run's fits, for the README."""

import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlencode

import numpy as np
from PIL import Image

from app.data import readers, road
from app.parts import widgets
from app.servers.browser import settled_picture
from tom.envs import ROAD
from tom.errors import UserError

if TYPE_CHECKING:
    from playwright.sync_api import Browser

FEWEST, FRAMES = 3, 16
"""minimum and maximum number of fits in an animation"""
FRAME_MS, LAST_MS = 600, 2400
WIDTH, HEIGHT = 1280, 800
SHOWN_WIDTHS = (960, 720, 480)
"""tried from the first on"""
LIMIT_BYTES = 2_000_000
"""never exceeded"""
QUALITIES = (80, 60, 40, 20)


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
        ("road", {r.run_id: road.steps(r) for r in runs if r.env == ROAD}),
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
