"""Words in a 3D scene, in the page's own colours.

viser's labels are black on a white box in every theme (its shader says so), so words are painted
here and stand in the scene as pictures. They face the place where the reader's camera starts, and
turn round when it comes to see them from behind or from below.
"""

from dataclasses import dataclass
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


Vector = tuple[float, float, float]


@dataclass
class Words:
    """Words in a scene: their picture, and where they stand."""

    node: viser.ImageHandle
    foot: Vector
    """the middle of their lower edge"""
    tilt: float
    turned: tuple[bool, bool] = (False, False)
    """round the upright, and over: as they stand now"""

    def face(self, camera: NDArray[np.float64]) -> None:
        """Stand so that who looks from `camera` (3,) reads no letter the wrong way round."""
        _, y, z = np.asarray(camera) - self.foot
        below = np.sin(self.tilt) * abs(y) + np.cos(self.tilt) * z < 0
        if (turned := (bool(y > 0), bool(below))) != self.turned:
            self.turned = turned
            self.node.wxyz, self.node.position = self._pose()

    def _pose(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """How the picture is turned (wxyz), and its middle."""
        round_about, over = self.turned
        angle = np.pi - self.tilt if over else self.tilt
        across, along = np.cos(angle / 2), np.sin(angle / 2)
        turn = (0.0, 0.0, along, across) if round_about else (across, along, 0.0, 0.0)
        up = np.array([0.0, np.cos(angle) * (-1 if round_about else 1), np.sin(angle)])
        return np.array(turn), np.array(self.foot) + self.node.render_height / 2 * up


def add_words(
    scene: viser.SceneApi,
    name: str,
    words: str,
    mode: Mode,
    foot: Vector,
    height: float,
    tilt: float,
) -> Words:
    """Words whose lower edge has its middle at `foot`; `height` of the letters in metres.

    `tilt` is the angle from the ground: 0 lies flat, read from above, pi / 2 stands, read from -y.
    """
    image = painted(words, mode)
    across, high = extent(words, mode, height)
    node = scene.add_image(
        name,
        np.ascontiguousarray(image[::-1]),  # viser lays a picture's first row to the lowest y
        across,
        high,
        format="png",
        cast_shadow=False,
        receive_shadow=False,
    )
    made = Words(node, foot, tilt)
    node.wxyz, node.position = made._pose()
    return made
