"""Attention cinema as files: the page itself, an MP4, and a small moving picture for a README."""

import base64
import io
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from PIL import Image

from app.data import readers
from app.parts import widgets
from app.scenes.film import HEIGHT, SECONDS, WIDTH, cinema
from app.scenes.film.story import may_be_told, story
from app.servers.browser import animation, chromium, scaled
from app.theme import Mode
from tom.cli.output import ProgressReport
from tom.errors import UserError
from tom.record.files import replace

if TYPE_CHECKING:
    from playwright.sync_api import Page

SHORT_S, SHORT_RATE, SHORT_WIDTH = 14, 8, 800
"""of the moving picture"""
QUALITIES = (60, 45, 30, 18)

_FILM = """async (length) => {
  film.stop();
  const made = await encoded(film, length, drawn);
  const letters = [];
  for (let i = 0; i < made.length; i += 8192)
    letters.push(String.fromCharCode(...made.subarray(i, i + 8192)));
  return btoa(letters.join(""));
}"""
_PICTURE = """(seconds) => {
  film.stop();
  film.draw(seconds);
  return document.querySelector("canvas").toDataURL("image/png").split(",")[1];
}"""


def export(
    store: Path, run_id: str, folder: Path, mode: Mode = "light", seconds: float = SECONDS
) -> int:
    """Write `cinema.html`, `cinema.mp4` and `cinema.webp` of a run into `folder`. Returns 0.

    Raises UserError for a run without a story, and if the browser is missing.
    """
    run = next((r for r in readers.listing(str(store)).runs if r.run_id == run_id), None)
    if run is None:
        raise UserError(f"no run '{run_id}' in {store}: name one of `tom runs list`")
    if not may_be_told(run):
        raise UserError(f"run '{run_id}' has no story: it needs model fits and its buffer")
    page = cinema(story(run), run.learner, mode, seconds)
    with opened(page) as tab:
        with ProgressReport("seconds of the film", round(seconds), sys.stderr) as bar:
            film = video(tab, seconds, lambda share: bar.step())
        short = moving_picture(tab, seconds)
    folder.mkdir(parents=True, exist_ok=True)  # all of it is made, or none
    for name, content in (("html", page.encode()), ("mp4", film), ("webp", short)):
        replace(
            folder / f"cinema.{name}", lambda file, content=content: file.write(content), sync=False
        )
        print(folder / f"cinema.{name}", flush=True)
    return 0


@contextmanager
def opened(page: str) -> Iterator["Page"]:
    """The page in a headless browser, opened from a file."""
    with TemporaryDirectory(prefix="tom-cinema-") as folder, chromium() as browser:
        path = Path(folder) / "cinema.html"
        path.write_text(page)
        tab = browser.new_page(viewport={"width": WIDTH, "height": HEIGHT + 60})
        tab.set_default_timeout(0)
        tab.goto(path.as_uri())
        yield tab


def video(tab: "Page", length: float, drawn: Callable[[float], None] = lambda share: None) -> bytes:
    """The whole film as an MP4 of `length` seconds; `drawn` is called with the share done."""
    tab.expose_function("drawn", drawn)
    return base64.b64decode(tab.evaluate(_FILM, length))


def moving_picture(tab: "Page", seconds: float) -> bytes:
    """The film in SHORT_S seconds as a WebP. Raises UserError if it would be too large."""
    count = SHORT_S * SHORT_RATE
    frames = []
    for i in range(count):
        content = base64.b64decode(tab.evaluate(_PICTURE, seconds * i / (count - 1)))
        frames.append(scaled(Image.open(io.BytesIO(content)), SHORT_WIDTH))
    return animation(frames, [SHORT_WIDTH], QUALITIES, (1000 // SHORT_RATE, 2500))


def most_telling(store: Path) -> str:
    """The default run for the cinema. Raises UserError if no run has a story."""
    told = [run for run in readers.listing(str(store)).runs if may_be_told(run)]
    if not told:
        raise UserError(f"no run in {store} has a story: it needs model fits and its buffer")
    return min(told, key=widgets.telling).run_id
