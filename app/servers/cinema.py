"""Attention cinema as files: the page itself, an MP4, and a small moving picture for a README."""

import base64
import io
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from struct import pack
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from PIL import Image

from app.data import readers
from app.parts import widgets
from app.scenes.film import HEIGHT, SECONDS, WIDTH, cinema
from app.scenes.film.story import may_be_told, story
from app.servers.browser import animation, chromium, scaled
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
TIMESCALE = 600
"""ticks per second"""
_MATRIX = pack(">9I", 0x10000, 0, 0, 0, 0x10000, 0, 0, 0, 0x40000000)


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


@dataclass(frozen=True)
class Sample:
    """One encoded picture."""

    data: bytes
    key: bool  # it can be shown without earlier pictures


def mp4(samples: Sequence[Sample], description: bytes, size: tuple[int, int], rate: int) -> bytes:
    """The file of ordered pictures, `rate` per second; `description` is the codec's avcC."""
    head = _box("ftyp", b"isom", pack(">I", 512), b"isomiso2avc1mp41")
    # The track contains the offsets of its pictures, which depend on the track's length.
    length = len(_moov(samples, description, size, rate, 0))
    moov = _moov(samples, description, size, rate, len(head) + length + 8)
    return head + moov + _box("mdat", *(sample.data for sample in samples))


def _moov(
    samples: Sequence[Sample], description: bytes, size: tuple[int, int], rate: int, offset: int
) -> bytes:
    ticks = TIMESCALE // rate
    duration = ticks * len(samples)
    times = pack(">4I", 0, 0, TIMESCALE, duration)
    rest = pack(">IHH2I", 0x10000, 0x100, 0, 0, 0) + _MATRIX + bytes(24) + pack(">I", 2)
    return _box(
        "moov",
        _full("mvhd", 0, times, rest),
        _box(
            "trak",
            _full(
                "tkhd", 3, pack(">5I", 0, 0, 1, 0, duration), bytes(16), _MATRIX,
                pack(">2I", size[0] << 16, size[1] << 16),
            ),
            _box(
                "mdia",
                _full("mdhd", 0, times, pack(">HH", 0x55C4, 0)),  # language: undetermined
                _full("hdlr", 0, bytes(4), b"vide", bytes(12), b"film\0"),
                _box(
                    "minf",
                    _full("vmhd", 1, bytes(8)),
                    _box("dinf", _full("dref", 0, pack(">I", 1), _full("url ", 1))),
                    _table(samples, description, size, ticks, offset),
                ),
            ),
        ),
    )  # fmt: skip


def _table(
    samples: Sequence[Sample], description: bytes, size: tuple[int, int], ticks: int, offset: int
) -> bytes:
    """The sample table: format, duration, size and offset of the pictures."""
    keys = [number for number, sample in enumerate(samples, 1) if sample.key]
    sizes = [len(sample.data) for sample in samples]
    entry = _box(
        "avc1", bytes(6), pack(">H", 1), bytes(16), pack(">HH", *size),
        pack(">2I", 0x480000, 0x480000), bytes(4), pack(">H", 1), bytes(32), pack(">Hh", 24, -1),
        _box("avcC", description),
    )  # fmt: skip
    count = len(samples)
    return _box(
        "stbl",
        _full("stsd", 0, pack(">I", 1), entry),
        _full("stts", 0, pack(">3I", 1, count, ticks)),
        _full("stss", 0, pack(f">{len(keys) + 1}I", len(keys), *keys)),
        _full("stsc", 0, pack(">4I", 1, 1, count, 1)),
        _full("stsz", 0, pack(f">{count + 2}I", 0, count, *sizes)),
        _full("stco", 0, pack(">2I", 1, offset)),
    )


def _box(kind: str, *parts: bytes) -> bytes:
    content = b"".join(parts)
    return pack(">I", len(content) + 8) + kind.encode() + content


def _full(kind: str, flags: int, *parts: bytes) -> bytes:
    """A box with version 0 and flags."""
    return _box(kind, pack(">I", flags), *parts)
