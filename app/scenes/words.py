"""Words in a 3D scene, in the page's own colours.

viser's labels are black on a white box in every theme (its shader says so), so words are painted
here and stand in the scene as pictures: they face the place where the reader's camera starts.
"""

from functools import lru_cache

import numpy as np
import viser
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

from app.theme import BACKGROUND, TEXT, Mode

PIXELS = 32
"""height of the letters in the picture"""
HALO = 2
"""pixels of the page's own colour around every letter, so that it can be read on anything"""


@lru_cache(maxsize=64)
def painted(words: str, mode: Mode) -> NDArray[np.uint8]:
    """The words (h, w, 4), clear where there is no letter; first row on top."""
    font = ImageFont.load_default(PIXELS)
    left, top, right, bottom = (int(x) for x in font.getbbox(words, stroke_width=HALO))
    image = Image.new("RGBA", (right - left + 2, bottom - top + 2), f"{BACKGROUND[mode]}00")
    ImageDraw.Draw(image).text(
        (1 - left, 1 - top), words, TEXT[mode], font,
        stroke_width=HALO, stroke_fill=f"{BACKGROUND[mode]}b0",
    )  # fmt: skip
    return np.asarray(image)


def extent(words: str, mode: Mode, height: float) -> tuple[float, float]:
    """Width and height in metres of words whose letters are `height` high."""
    high, across = painted(words, mode).shape[:2]
    return height / PIXELS * across, height / PIXELS * high


def add_words(
    scene: viser.SceneApi,
    name: str,
    words: str,
    mode: Mode,
    foot: tuple[float, float, float],
    height: float,
    tilt: float,
) -> viser.ImageHandle:
    """Words whose lower edge has its middle at `foot`; `height` of the letters in metres.

    `tilt` is the angle from the ground: 0 lies flat, read from above, pi / 2 stands, read from -y.
    """
    image = painted(words, mode)
    across, high = extent(words, mode, height)
    up = np.array([0.0, np.cos(tilt), np.sin(tilt)])
    return scene.add_image(
        name,
        np.ascontiguousarray(image[::-1]),  # viser lays a picture's first row to the lowest y
        across,
        high,
        format="png",
        cast_shadow=False,
        receive_shadow=False,
        wxyz=(float(np.cos(tilt / 2)), float(np.sin(tilt / 2)), 0.0, 0.0),
        position=np.array(foot) + high / 2 * up,
    )
