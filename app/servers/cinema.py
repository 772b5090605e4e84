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
from app.scenes.film import HEIGHT, SECONDS, WIDTH, cinema, has_story, story
from app.servers.browser import chromium
from app.theme import Mode
from tom.cli.output import ProgressReport
from tom.errors import UserError
from tom.record.files import replace

if TYPE_CHECKING:
    from playwright.sync_api import Page

SHORT_S, SHORT_RATE, SHORT_WIDTH, QUALITY = 14, 8, 800, 45
"""of the small moving picture: seconds, pictures a second, pixels, and how well it is kept"""

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


def export(store: Path, run_id: str | None, folder: Path, mode: Mode) -> int:
    """Write `cinema.html`, `cinema.mp4` and `cinema.webp` of a run into `folder`. Returns 0.

    Without a run it is the first that weighs. Raises UserError without a story, or a browser.
    """
    runs = [run for run in readers.listing(str(store)).runs if run_id in (None, run.run_id)]
    with_story = [run for run in runs if has_story(run)]
    if not runs and run_id:
        raise UserError(f"no run '{run_id}' in {store}: name one of `tom runs list`")
    if not with_story:
        which = f"run '{run_id}'" if run_id else f"a run in {store}"
        raise UserError(f"no story of {which}: it needs model fits and its buffer")
    run = min(with_story, key=widgets.interest_key)
    page = cinema(story(run), run.learner, mode)
    with film_tab(page) as tab:
        with ProgressReport("seconds of the film", round(SECONDS), sys.stderr) as bar:
            film = video(tab, SECONDS, lambda share: bar.step())
        count, frames = SHORT_S * SHORT_RATE, []
        for i in range(count):
            content = base64.b64decode(tab.evaluate(_PICTURE, SECONDS * i / (count - 1)))
            frame = Image.open(io.BytesIO(content)).convert("RGB")
            size = SHORT_WIDTH, round(frame.height * SHORT_WIDTH / frame.width)
            frames.append(frame.resize(size, Image.Resampling.LANCZOS))
    short, each = io.BytesIO(), 1000 // SHORT_RATE
    frames[0].save(
        short, "WEBP", save_all=True, append_images=frames[1:], loop=0, quality=QUALITY,
        duration=[each] * (count - 1) + [2500], method=4,
    )  # fmt: skip
    folder.mkdir(parents=True, exist_ok=True)  # all of it is made, or none
    for name, content in (("html", page.encode()), ("mp4", film), ("webp", short.getvalue())):
        path = folder / f"cinema.{name}"
        replace(path, lambda file, content=content: file.write(content), sync=False)
        print(path, flush=True)
    return 0


@contextmanager
def film_tab(page: str) -> Iterator["Page"]:
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
