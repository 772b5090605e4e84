"""The browser frame that shows road-and-rocks in 3D."""

from functools import lru_cache

from app import pictures
from app.pictures import Picture
from app.scenes import road as scene
from app.scenes.control import Road, Selection
from app.scenes.frame import Frame
from tom.errors import UserError
from tom.record.reader import RunReader
from tom.record.store import Store

PLAY_S = 0.8
"""seconds that a fit is shown while the slider plays"""


@lru_cache(maxsize=64)
def _picture(path: str, step: int) -> Picture | None:
    return pictures.load(RunReader(path), step)


class RoadFrame(Frame):
    """Shows fits of road-and-rocks runs."""

    title = "Road and rocks"

    def _build_panel(self) -> None:
        self._handles: scene.Handles | None = None
        self._drawn: tuple[str, int] | None = None
        self._steps: list[int] = []
        self._since = 0.0
        self.look(scene.CAMERA, scene.LOOK_AT)
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

    def _show(self, selection: Selection) -> None:
        choice = selection.choice
        assert isinstance(choice, Road)
        runs = self._runs()
        if not runs:
            return
        self.run.options = tuple(runs)
        self.run.value = next((run for run in choice.runs if run in runs), runs[0])
        self._read_steps()
        if choice.step in self._steps:
            self.fit.value = self._steps.index(choice.step)
        self._redraw()

    def _mode_changed(self) -> None:
        self._drawn = None

    def _tick(self, seconds: float) -> None:
        """The next fit while the slider plays; after the last the first."""
        self._since += seconds
        if self.play.value and len(self._steps) > 1 and self._since >= PLAY_S:
            self._since = 0.0
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
