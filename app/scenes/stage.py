"""The light, floor and background of scenes; the floor moves under a followed robot."""

import numpy as np
import viser

from app.scenes.colours import rgb
from app.theme import BACKGROUND, Mode

GLOW: dict[Mode, float] = {"light": 1.7, "dark": 1.1}
"""brightness of the ambient light"""
CELL = 0.5
"""metres between two lines of the floor"""
SECTION = 2.0
"""metres between two thick lines"""
_FLOOR: dict[Mode, tuple[str, str, str]] = {
    "light": ("#eef0f4", "#d3d8e2", "#aab2c2"),
    "dark": ("#171b24", "#2b3240", "#465066"),
}
"""plane, thin lines, thick lines"""


def floor(scene: viser.SceneApi, height: float, mode: Mode) -> viser.GridHandle:
    """An infinite floor at `height` metres."""
    plane, thin, thick = (rgb(colour) for colour in _FLOOR[mode])
    return scene.add_grid(
        "/floor",
        infinite_grid=True,
        cell_size=CELL,
        cell_color=thin,
        section_size=SECTION,
        section_color=thick,
        fade_distance=18.0,
        plane_color=plane,
        plane_opacity=1.0,
        shadow_opacity=0.25,
        position=(0.0, 0.0, height),
    )


def light(scene: viser.SceneApi, mode: Mode, front: float) -> None:
    """Ambient light, and light of some brightness from the front, towards the origin."""
    scene.add_light_ambient("/glow", intensity=GLOW[mode])
    scene.add_light_directional("/fill", intensity=front, position=(-1.5, -4.0, 2.5))


def sky(scene: viser.SceneApi, mode: Mode) -> None:
    """The page's background colour."""
    scene.set_background_image(np.full((1, 1, 3), rgb(BACKGROUND[mode]), np.uint8))


def under(place: np.ndarray, height: float) -> tuple[float, float, float]:
    """The floor's position when a robot at `place` (3,) is drawn at the origin."""
    x, y = -np.mod(place[:2], SECTION)
    return float(x), float(y), height
