"""Words in a 3D scene, in the page's own colours.

viser's labels are black on a white box in every theme, so words are painted here and placed in the
scene as pictures. They face the first position of the camera, and turn when it sees them from
behind or from below. In a page without a server they cannot turn, so two pictures are placed back
to back.
"""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import viser
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from trimesh import Trimesh
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from app.theme import BACKGROUND, TEXT, Mode

PIXELS = 32
"""height of the letters in the picture"""
HALO = 2
"""pixels of the page's background around every letter, for contrast"""


@lru_cache(maxsize=64)
def painted(words: str, mode: Mode) -> NDArray[np.uint8]:
    """The words as a picture (h, w, 4), transparent between letters; first row on top."""
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
    """Words in a scene: their picture and position."""

    node: viser.ImageHandle
    image: NDArray[np.uint8]
    """(h, w, 4), first row on top"""
    foot: Vector
    """the middle of their lower edge"""
    tilt: float
    turned: tuple[bool, bool] = (False, False)
    """current rotation around the vertical, and whether upside down"""

    def face(self, camera: NDArray[np.float64]) -> None:
        """Turn so that the letters are readable from `camera` (3,)."""
        _, y, z = np.asarray(camera) - self.foot
        below = np.sin(self.tilt) * abs(y) + np.cos(self.tilt) * z < 0
        if (turned := (bool(y > 0), bool(below))) != self.turned:
            self.turned = turned
            self.node.wxyz, self.node.position = self._pose()

    def _pose(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The picture's orientation (wxyz) and centre."""
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
    """Add words whose lower edge is centred at `foot`; `height` of the letters in metres.

    `tilt` is the angle from the ground: 0 is flat, read from above; pi / 2 is upright, read from
    -y.
    """
    image = painted(words, mode)
    across, high = extent(words, mode, height)
    node = scene.add_image(
        name,
        np.ascontiguousarray(image[::-1]),  # viser puts a picture's first row at the lowest y
        across,
        high,
        format="png",
        cast_shadow=False,
        receive_shadow=False,
    )
    made = Words(node, image, foot, tilt)
    node.wxyz, node.position = made._pose()
    return made


def fix(scene: viser.SceneApi, words: Words) -> list[viser.GlbHandle]:
    """Replace the words by two pictures back to back, readable from both sides."""
    words.node.visible = False
    across, along = np.cos(words.tilt / 2), np.sin(words.tilt / 2)
    picture = _one_sided(words)
    return [
        scene.add_mesh_trimesh(
            f"{words.node.name} {side}", picture, wxyz=turn, position=words.node.position,
            cast_shadow=False, receive_shadow=False,
        )
        for side, turn in (("front", (across, along, 0, 0)), ("back", (0, 0, across, along)))
    ]  # fmt: skip


def _one_sided(words: Words) -> Trimesh:
    """The picture as a rectangle in x and y that is visible only from +z, as in glTF."""
    x, y = words.node.render_width / 2, words.node.render_height / 2
    texture = Image.fromarray(words.image)
    # Emissive, because pale letters would be grey under the scene's light.
    material = PBRMaterial(
        baseColorTexture=texture, emissiveTexture=texture, emissiveFactor=(1, 1, 1),
        alphaMode="BLEND", metallicFactor=0.0, roughnessFactor=1.0, doubleSided=False,
    )  # fmt: skip
    corners = [(0, 0), (1, 0), (1, 1), (0, 1)]
    return Trimesh(
        [(x * (2 * right - 1), y * (2 * up - 1), 0) for right, up in corners],
        [(0, 1, 2), (0, 2, 3)],
        visual=TextureVisuals(uv=np.array(corners, float), material=material),
        process=False,
    )
