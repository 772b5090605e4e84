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
from app.scenes.film.page import HEIGHT, SECONDS, WIDTH, cinema
from app.scenes.film.story import may_be_told, story
from app.servers.browser import chromium
from app.servers.mp4 import Sample, mp4
from app.servers.screen_capture import LIMIT_BYTES
from app.theme import Mode
from tom.cli.progress import CountReport
from tom.errors import UserError
from tom.record.files import replace

if TYPE_CHECKING:
    from playwright.sync_api import Page

RATE = 30
"""pictures per second of the MP4"""
CODEC, BITS_PER_SECOND = "avc1.64001f", 4_000_000
AT_ONCE = 30
"""pictures that the browser encodes at a time"""
SHORT_S, SHORT_RATE, SHORT_WIDTH = 14, 8, 800
"""of the moving picture"""
QUALITIES = (60, 45, 30, 18)

_BEGIN = """([codec, bitrate, framerate]) => {
  film.stop();
  const [width, height] = film.size;
  window.made = [];
  window.encoder = new VideoEncoder({
    output: (chunk, more) => {
      const data = new Uint8Array(chunk.byteLength);
      chunk.copyTo(data);
      made.push({ key: chunk.type === "key", data });
      const told = more?.decoderConfig?.description;
      if (told) window.description = new Uint8Array(told.buffer ?? told);
    },
    error: (problem) => { window.problem = String(problem); },
  });
  encoder.configure({ codec, width, height, bitrate, framerate, avc: { format: "avc" } });
}"""
_ENCODE = """async ([first, last, rate, stretch]) => {
  const text = (bytes) => {
    let letters = "";
    for (let i = 0; i < bytes.length; i += 8192)
      letters += String.fromCharCode(...bytes.subarray(i, i + 8192));
    return btoa(letters);
  };
  for (let i = first; i < last; i++) {
    film.draw((i / rate) * stretch);
    const timestamp = Math.round((1e6 * i) / rate);
    const picture = new VideoFrame(document.querySelector("canvas"), { timestamp });
    encoder.encode(picture, { keyFrame: i % (2 * rate) === 0 });
    picture.close();
  }
  await encoder.flush();
  if (window.problem) throw new Error(window.problem);
  return made.splice(0).map(({ key, data }) => [key, text(data)])
    .concat([[null, text(window.description)]]);
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
        with CountReport("seconds of the film", round(seconds), sys.stderr) as bar:
            film = video(tab, seconds, drawn=bar.step)
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


def video(
    tab: "Page",
    seconds: float,
    length: float | None = None,
    drawn: Callable[[], None] = lambda: None,
) -> bytes:
    """The film as an MP4 of `length` seconds (default: the whole film).

    `drawn` is called after each AT_ONCE pictures.
    """
    length = seconds if length is None else length
    count = round(length * RATE)
    tab.evaluate(_BEGIN, [CODEC, BITS_PER_SECOND, RATE])
    samples, description = list[Sample](), b""
    for first in range(0, count, AT_ONCE):
        span = [first, min(first + AT_ONCE, count), RATE, seconds / length]
        *pictures, (_, told) = tab.evaluate(_ENCODE, span)
        samples += [Sample(base64.b64decode(data), bool(key)) for key, data in pictures]
        description = base64.b64decode(told)
        drawn()
    return mp4(samples, description, (WIDTH, HEIGHT), RATE)


def moving_picture(tab: "Page", seconds: float) -> bytes:
    """The film in SHORT_S seconds as a WebP. Raises UserError if it exceeds LIMIT_BYTES."""
    count = SHORT_S * SHORT_RATE
    height = round(SHORT_WIDTH * HEIGHT / WIDTH)
    frames = []
    for i in range(count):
        content = base64.b64decode(tab.evaluate(_PICTURE, seconds * i / (count - 1)))
        picture = Image.open(io.BytesIO(content)).convert("RGB")
        frames.append(picture.resize((SHORT_WIDTH, height), Image.Resampling.LANCZOS))
    size = 0
    for quality in QUALITIES:
        content = io.BytesIO()
        frames[0].save(
            content, "WEBP", save_all=True, append_images=frames[1:], loop=0, quality=quality,
            duration=[1000 // SHORT_RATE] * (count - 1) + [2500], method=4,
        )  # fmt: skip
        size = len(content.getvalue())
        if size <= LIMIT_BYTES:
            return content.getvalue()
    raise UserError(
        f"the moving picture would take {size / 1e6:.1f} MB, more than {LIMIT_BYTES / 1e6:g}"
    )


def most_telling(store: Path) -> str:
    """The default run for the cinema. Raises UserError if no run has a story."""
    told = [run for run in readers.listing(str(store)).runs if may_be_told(run)]
    if not told:
        raise UserError(f"no run in {store} has a story: it needs model fits and its buffer")
    return min(told, key=widgets.telling).run_id
