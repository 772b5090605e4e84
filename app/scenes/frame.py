"""What all scenes have: a browser frame with its panel, the light, the floor, the sky and words.

viser's labels are black on a white box in every theme, so words are painted here in the page's own
colours and placed in the scene as pictures: two back to back, so that no letter is mirrored.
"""

import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import viser
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont
from trimesh import Trimesh
from trimesh.visual import TextureVisuals
from trimesh.visual.material import PBRMaterial

from app.scenes.control import Clock, Selection
from app.theme import ACCENT, BACKGROUND, TEXT, Mode, rgb

Vector = tuple[float, float, float]

GLOW: dict[Mode, float] = {"light": 1.7, "dark": 1.1}
"""brightness of the ambient light"""
CELL, SECTION = 0.5, 2.0
"""metres between two lines of the floor, and between two thick ones"""
_FLOOR: dict[Mode, tuple[str, str, str]] = {
    "light": ("#eef0f4", "#d3d8e2", "#aab2c2"),
    "dark": ("#171b24", "#2b3240", "#465066"),
}
"""plane, thin lines, thick lines"""
PIXELS = 32
"""height of the letters in the picture"""
HALO = 2
"""pixels of the page's background around every letter, for contrast"""
ASPECT = 16 / 9
"""width over height of a picture whose frame is not known"""


class Frame:
    """One connected browser frame that shows one kind of scene."""

    title: str
    """the title of the panel"""
    fill = 0.0
    """brightness of the front light"""
    shadows = False
    """shadows halve the frame rate on a slow machine"""
    folded = True
    """whether the panel is closed at first, because it would cover the scene"""

    def __init__(self, client: viser.ClientHandle, mode: Mode) -> None:
        self.client = client
        self.mode: Mode = mode
        self._drawn: Any = None
        """what the scene shows; None if it must be drawn anew"""
        self._lock = threading.RLock()
        self._closed = False
        self._apply_theme()
        client.gui.set_panel_label(self.title)
        self._build_panel()
        if self.folded:
            client.gui.main_panel.minimize()

    def show(self, selection: Selection, *, obey: bool = False) -> None:
        """Show a page's choice; with `obey`, carry out its request too.

        Raises UserError if it cannot be read.
        """
        with self._lock:
            if selection.mode != self.mode:
                self.mode, self._drawn = selection.mode, None
                self._apply_theme()
            self._show(selection.choice, obey=obey)

    def close(self) -> None:
        """Clear the scene and the panel for a frame of another kind."""
        with self._lock:
            self._closed = True
            self.client.gui.reset()
            self.client.scene.reset()

    def tick(self, seconds: float) -> None:
        """Advance playback by `seconds`."""
        with self._lock:
            if not self._closed:  # the clock may still tick a frame that was just replaced
                self._tick(seconds)

    def clock(self) -> Clock | None:
        """The state of playback; None if this kind of scene plays nothing."""
        return None

    def set_camera(self, position: Vector, at: Vector, corner: Vector | None = None) -> None:
        """Set the user's camera, so far back that `corner` is in its picture."""
        camera = self.client.camera
        if corner is not None:
            high = camera.image_height  # 0 in a tab that was never in front
            aspect = camera.image_width / high if high else ASPECT
            position = stand_back(position, at, corner, camera.fov, aspect)
        camera.position, camera.look_at = position, at

    def clear(self) -> None:
        """Remove everything from the scene except the light and the page's background."""
        self.client.scene.reset()
        set_up_lights(self.client.scene, self.mode, self.fill)

    def on_scrub(self, slider: viser.GuiSliderHandle, moved: Callable[[float], None]) -> None:
        """Call `moved` with the slider's value if the user has moved it, not playback."""

        def updated(event: viser.GuiEvent) -> None:
            if event.client is not None:
                with self._lock:
                    moved(float(slider.value))

        slider.on_update(updated)

    def _apply_theme(self) -> None:
        scene = self.client.scene
        self.client.gui.configure_theme(
            dark_mode=self.mode == "dark",
            show_logo=False,
            show_share_button=False,
            control_width="small",
            brand_color=rgb(ACCENT[self.mode]),
        )
        scene.configure_default_lights(cast_shadow=self.shadows)
        # No environment map: viser fades in the canvas after its default map is loaded. If another
        # map arrives meanwhile, the scene stays pale until it is opened again.
        scene.configure_environment_map(None)
        set_up_lights(scene, self.mode, self.fill)

    def _build_panel(self) -> None:
        raise NotImplementedError

    def _show(self, choice: Any, *, obey: bool) -> None:
        raise NotImplementedError

    def _tick(self, seconds: float) -> None:
        raise NotImplementedError


def stand_back(position: Vector, at: Vector, corner: Vector, fov: float, aspect: float) -> Vector:
    """The position of a camera that looks `at` a point, farther back if `corner` is not in sight.

    Its picture is `fov` radians high and `aspect` times as wide.
    """
    back = np.subtract(position, at)
    away = np.linalg.norm(back)
    behind = back / away
    right = np.cross((0.0, 0.0, 1.0), behind)
    right /= np.linalg.norm(right)
    across, up, nearer = np.stack([right, np.cross(behind, right), behind]) @ np.subtract(
        corner, at
    )
    needed = nearer + max(abs(across) / aspect, abs(up)) / np.tan(fov / 2)
    x, y, z = (at + max(away, needed) * behind).tolist()
    return x, y, z


def set_up_lights(scene: viser.SceneApi, mode: Mode, front: float) -> None:
    """The page's background, ambient light, and light of some brightness from the front."""
    scene.set_background_image(np.full((1, 1, 3), rgb(BACKGROUND[mode]), np.uint8))
    scene.add_light_ambient("/glow", intensity=GLOW[mode])
    scene.add_light_directional("/fill", intensity=front, position=(-1.5, -4.0, 2.5))


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


def text_picture(text: str, mode: Mode) -> NDArray[np.uint8]:
    """The words as a picture (h, w, 4), transparent between letters; first row on top."""
    font = ImageFont.load_default(PIXELS)
    left, top, right, bottom = (int(x) for x in font.getbbox(text, stroke_width=HALO))
    image = Image.new("RGBA", (right - left + 2, bottom - top + 2), f"{BACKGROUND[mode]}00")
    ImageDraw.Draw(image).text(
        (1 - left, 1 - top), text, TEXT[mode], font,
        stroke_width=HALO, stroke_fill=f"{BACKGROUND[mode]}b0",
    )  # fmt: skip
    return np.asarray(image)


def text_extent(text: str, mode: Mode, height: float) -> NDArray[np.float64]:
    """Width and height (2,) in metres of words whose letters are `height` high."""
    return height / PIXELS * np.array(text_picture(text, mode).shape[1::-1])


def add_text(
    scene: viser.SceneApi,
    name: str,
    text: str,
    mode: Mode,
    foot: Vector,
    height: float,
    tilt: float,
) -> list[viser.GlbHandle]:
    """Add words whose lower edge is centred at `foot`; `height` of the letters in metres.

    `tilt` is the angle from the ground: 0 is flat, read from above; pi / 2 is upright, read from
    -y and from behind.
    """
    size = text_extent(text, mode, height)
    texture = Image.fromarray(text_picture(text, mode))
    # It shines and reflects nothing: under the scene's light the letters would change their colour.
    material = PBRMaterial(
        baseColorTexture=texture, baseColorFactor=(0, 0, 0, 255),
        emissiveTexture=texture, emissiveFactor=(1, 1, 1),
        alphaMode="BLEND", metallicFactor=1.0, roughnessFactor=1.0, doubleSided=False,
    )  # fmt: skip
    corners = np.array([(0, 0), (1, 0), (1, 1), (0, 1)], float)
    picture = Trimesh(  # visible only from +z, as in glTF
        np.column_stack([(corners - 0.5) * size, np.zeros(4)]),
        [(0, 1, 2), (0, 2, 3)],
        visual=TextureVisuals(uv=corners, material=material),
        process=False,
    )
    middle = np.array(foot) + size[1] / 2 * np.array([0.0, np.cos(tilt), np.sin(tilt)])
    across, along = np.cos(tilt / 2), np.sin(tilt / 2)
    return [
        scene.add_mesh_trimesh(
            f"{name} {side}", picture, wxyz=turn, position=middle,
            cast_shadow=False, receive_shadow=False,
        )
        for side, turn in (("front", (across, along, 0, 0)), ("back", (0, 0, across, along)))
    ]  # fmt: skip
