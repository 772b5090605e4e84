"""Words in a 3D scene, in the page's own colours.

viser's labels are black on a white box in every theme, so words are painted here and placed in the
scene as pictures: two back to back, so that no letter is mirrored from behind.
"""

import numpy as np
import viser
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from trimesh import Trimesh
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from app.theme import BACKGROUND, TEXT, Mode

Vector = tuple[float, float, float]

PIXELS = 32
"""height of the letters in the picture"""
HALO = 2
"""pixels of the page's background around every letter, for contrast"""


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


def add_words(
    scene: viser.SceneApi,
    name: str,
    words: str,
    mode: Mode,
    foot: Vector,
    height: float,
    tilt: float,
) -> list[viser.GlbHandle]:
    """Add words whose lower edge is centred at `foot`; `height` of the letters in metres.

    `tilt` is the angle from the ground: 0 is flat, read from above; pi / 2 is upright, read from
    -y and from behind.
    """
    width, high = extent(words, mode, height)
    picture = _one_sided(painted(words, mode), width, high)
    middle = np.array(foot) + high / 2 * np.array([0.0, np.cos(tilt), np.sin(tilt)])
    across, along = np.cos(tilt / 2), np.sin(tilt / 2)
    return [
        scene.add_mesh_trimesh(
            f"{name} {side}", picture, wxyz=turn, position=middle,
            cast_shadow=False, receive_shadow=False,
        )
        for side, turn in (("front", (across, along, 0, 0)), ("back", (0, 0, across, along)))
    ]  # fmt: skip


def _one_sided(image: NDArray[np.uint8], width: float, height: float) -> Trimesh:
    """A picture as a rectangle in x and y that is visible only from +z, as in glTF."""
    texture = Image.fromarray(image)
    # It shines and reflects nothing: under the scene's light the letters would change their colour.
    material = PBRMaterial(
        baseColorTexture=texture, baseColorFactor=(0, 0, 0, 255),
        emissiveTexture=texture, emissiveFactor=(1, 1, 1),
        alphaMode="BLEND", metallicFactor=0.0, roughnessFactor=1.0, doubleSided=False,
    )  # fmt: skip
    corners = np.array([(0, 0), (1, 0), (1, 1), (0, 1)], float)
    flat = (corners - 0.5) * (width, height)
    return Trimesh(
        np.column_stack([flat, np.zeros(4)]),
        [(0, 1, 2), (0, 2, 3)],
        visual=TextureVisuals(uv=corners, material=material),
        process=False,
    )
