"""One browser frame of the viser server: its panel, its scene, what it shows."""

import threading
from functools import lru_cache

import viser

from app import pictures
from app.colours import rgb
from app.pictures import Picture
from app.scenes import road as scene
from app.scenes.control import Selection
from app.theme import LEARNER_COLOURS, Mode
from tom.errors import UserError
from tom.record.reader import RunReader
from tom.record.store import Store

CAMERA = (0.5, -0.12, 0.82)
LOOK_AT = (0.5, 0.45, 0.0)
GLOW: dict[Mode, float] = {"light": 0.45, "dark": 0.3}
"""brightness of the light from all sides"""


@lru_cache(maxsize=64)
def _picture(path: str, step: int) -> Picture | None:
    return pictures.load(RunReader(path), step)


class Frame:
    """One connected browser frame: its panel, its scene, what it shows."""

    def __init__(self, client: viser.ClientHandle, store: str, selection: Selection) -> None:
        self.client = client
        self.store = store
        self.mode: Mode = selection.mode
        self._lock = threading.RLock()
        self._handles: scene.Handles | None = None
        self._drawn: tuple[str, int] | None = None
        self._steps: list[int] = []
        self._dress()
        client.gui.set_panel_label("Road and rocks")
        client.camera.position = CAMERA
        client.camera.look_at = LOOK_AT
        self._build_panel()
        self.show(selection)

    def _dress(self) -> None:
        self.client.gui.configure_theme(
            dark_mode=self.mode == "dark",
            show_logo=False,
            show_share_button=False,
            control_width="small",
            brand_color=rgb(LEARNER_COLOURS["tom"]),
        )
        # Shadows cost a weak machine half of its frames and show nothing of the data.
        self.client.scene.configure_default_lights(cast_shadow=False)
        self.client.scene.configure_environment_map("studio", environment_intensity=GLOW[self.mode])

    def _build_panel(self) -> None:
        gui = self.client.gui
        self.play = gui.add_checkbox("play the fits", initial_value=False)
        with gui.add_folder("Another run or fit", expand_by_default=False):
            self.run = gui.add_dropdown("run", tuple(self._runs()) or ("none",))
            self.fit = gui.add_slider("fit", 0, 1, 1, 0)
        with gui.add_folder("Layers", expand_by_default=False):
            self.layers = {
                name: gui.add_checkbox(label, initial_value=shown)
                for name, label, shown in (
                    ("columns", "weights as columns", True),
                    ("expert", "expert's trajectories", True),
                    ("learnt", "learnt policy's trajectories", True),
                    ("true", "real displacement", False),
                    ("modelled", "modelled displacement", False),
                    ("boulders", "rocks", True),
                )
            }
        self.run.on_update(lambda _: self._redraw())
        self.fit.on_update(lambda _: self._redraw())
        for layer in self.layers.values():
            layer.on_update(lambda _: self._apply_layers())

    def show(self, selection: Selection) -> None:
        """Show what a page chose."""
        with self._lock:
            if selection.mode != self.mode:
                self.mode, self._drawn = selection.mode, None
                self._dress()
            runs = self._runs()
            if not runs:
                return
            self.run.options = tuple(runs)
            self.run.value = selection.run if selection.run in runs else runs[0]
            self._read_steps()
            if selection.step in self._steps:
                self.fit.value = self._steps.index(selection.step)
            self._redraw()

    def next_fit(self) -> None:
        """The next fit while the slider plays; after the last the first."""
        if self.play.value and len(self._steps) > 1:
            self.fit.value = (int(self.fit.value) + 1) % len(self._steps)

    def _runs(self) -> list[str]:
        return [run.run_id for run in Store(self.store).runs() if run.env == pictures.ENV]

    def _read_steps(self) -> None:
        try:
            self._steps = pictures.steps(Store(self.store).run(self.run.value))
        except UserError:
            self._steps = []  # it was deleted or damaged meanwhile: the last picture stays
        last = max(len(self._steps) - 1, 1)
        self.fit.max = last
        self.fit.disabled = len(self._steps) < 2
        self.fit.value = min(int(self.fit.value), last)

    def _redraw(self) -> None:
        with self._lock:
            self._read_steps()
            if not self._steps:
                return
            step = self._steps[min(int(self.fit.value), len(self._steps) - 1)]
            path = str(Store(self.store).resolve(self.run.value))
            picture = _picture(path, step)
            if picture is None or self._drawn == (path, step):
                return
            self._drawn = (path, step)
            with self.client.atomic():
                self._handles = scene.draw(self.client.scene, picture, self.mode)
                self._apply_layers()

    def _apply_layers(self) -> None:
        if self._handles is not None:
            for name, box in self.layers.items():
                getattr(self._handles, name).visible = bool(box.value)
