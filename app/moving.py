"""Moving pictures of a page that goes through the fits of a run, for a README."""

import io
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import urlencode

import numpy as np
from PIL import Image

from app import readers, widgets
from app.browser import settled_picture
from app.pictures import ENV as ROAD

if TYPE_CHECKING:
    from playwright.sync_api import Browser

FRAMES = 16
FEWEST = 3
"""fits that make a story"""
FRAME_MS, LAST_MS = 600, 2400
WIDTH, HEIGHT = 1280, 800
SHOWN_WIDTH = 960
LIMIT_BYTES = 2_000_000
QUALITIES = (80, 60, 40, 20)


@dataclass(frozen=True)
class Story:
    """A page that shows one fit of a run after the other."""

    view: str
    run_id: str
    steps: tuple[int, ...]

    def addresses(self) -> Iterator[str]:
        """The page's path at every fit."""
        for step in self.steps:
            yield f"{self.view}?{urlencode({'run': self.run_id, 'step': step})}"


def stories(store: Path) -> list[Story]:
    """The weights of the run with the most fits, and the road-and-rocks run with the most."""
    runs = [run for run in readers.listing(str(store)).runs if widgets.differs(run)]
    found = []
    for view, steps in (
        ("weights", {r.run_id: readers.profiles(r).env_step for r in runs if r.env != ROAD}),
        ("road", {r.run_id: readers.road_steps(r) for r in runs if r.env == ROAD}),
    ):
        run_id = max(steps, key=lambda name: len(steps[name]), default=None)
        if run_id is not None and len(steps[run_id]) >= FEWEST:
            found.append(Story(view, run_id, spread(steps[run_id])))
    return found


def spread(steps: Sequence[int] | np.ndarray) -> tuple[int, ...]:
    """At most FRAMES of the steps, evenly, the first and the last among them."""
    index = np.unique(np.linspace(0, len(steps) - 1, FRAMES).round().astype(int))
    return tuple(int(steps[i]) for i in index)


def film(browser: "Browser", address: str, story: Story, target: Path) -> None:
    """Open the page at every fit and write what is seen as a moving WebP."""
    page = browser.new_page(viewport={"width": WIDTH, "height": HEIGHT}, color_scheme="light")
    frames = []
    for path in story.addresses():
        page.goto(f"{address}/{path}")
        frames.append(Image.open(io.BytesIO(settled_picture(page, whole=False))))
    page.close()
    write(frames, target)


def write(frames: Sequence[Image.Image], target: Path) -> None:
    """The frames one after the other, the last one longer, in at most LIMIT_BYTES."""
    small = [_scaled(frame) for frame in frames]
    content = _webp(small, QUALITIES[0])
    for quality in QUALITIES[1:]:
        if len(content) <= LIMIT_BYTES:
            break
        content = _webp(small, quality)
    target.write_bytes(content)


def _webp(frames: Sequence[Image.Image], quality: int) -> bytes:
    durations = [FRAME_MS] * (len(frames) - 1) + [LAST_MS]
    content = io.BytesIO()
    frames[0].save(
        content, "WEBP", save_all=True, append_images=list(frames[1:]), duration=durations,
        loop=0, quality=quality, method=4,
    )  # fmt: skip
    return content.getvalue()


def _scaled(frame: Image.Image) -> Image.Image:
    height = round(frame.height * SHOWN_WIDTH / frame.width)
    return frame.convert("RGB").resize((SHOWN_WIDTH, height), Image.Resampling.LANCZOS)
