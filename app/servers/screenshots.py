"""Screenshots of every page, by headless Chromium on a running studio."""

import io
from pathlib import Path
from threading import Event

from PIL import Image

from app.router import VIEWS
from app.servers import screen_capture
from app.servers.browser import chromium, settled_picture
from app.servers.launcher import Studio, servers
from app.theme import Mode

WIDTHS = (1280, 1920)
MODES: tuple[Mode, ...] = ("light", "dark")


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
        for story in screen_capture.stories(store):
            screen_capture.film(browser, links.address, story, folder / f"{story.view}.webp")
    return 0


def compact(picture: bytes) -> bytes:
    """The same picture in 256 colours: a third of the bytes, without visible difference."""
    image = Image.open(io.BytesIO(picture)).convert("RGB")
    small = io.BytesIO()
    image.quantize(256, Image.Quantize.MEDIANCUT).save(small, "PNG", optimize=True)
    return small.getvalue()
