"""Road-and-rocks in a browser frame, and as one HTML file that plays without a server."""

from collections.abc import Sequence

import viser

from app.data import road
from app.data.called import told_apart
from app.data.road import Picture
from app.scenes import road as scene
from app.scenes.control import RoadChoice
from app.scenes.frame import Frame, stage
from app.scenes.road import RoadScene
from app.theme import Mode
from tom.envs import ROAD
from tom.errors import UserError
from tom.machine.address import free_port
from tom.record.reader import at_or_before

PLAY_S = 1.0
"""seconds for which each fit is shown during playback"""
STEPS_PER_S = 20.0
"""steps of the task that the cars drive per second"""
REST = 20
"""steps that the cars wait after they have arrived"""
LAYERS = (
    ("columns", "weights as columns", True),
    ("flat", "weights as colours", False),
    ("expert", "expert's ways", True),
    ("learnt", "learnt policy's ways", True),
    ("cars", "cars", True),
    ("true", "real displacement", False),
    ("modelled", "modelled displacement", False),
    ("boulders", "rocks", True),
)
HERE = "127.0.0.1"
FRAME_S, STRIDE = 0.1, 2
"""of a film: seconds between two frames, and steps of the task"""
REST_S = 1.0
"""how long a film shows a fit after the cars have arrived"""


class RoadFrame(Frame):
    """Shows fits of road-and-rocks runs side by side."""

    title = "Road and rocks"

    def _build_panel(self) -> None:
        self._runs: tuple[str, ...] = ()
        self._steps: list[int] = []
        self._scenes: list[RoadScene] = []
        self._drawn: list[tuple[str, int]] = []
        self._since = 0.0
        self._driven = 0.0
        gui = self.client.gui
        self.fit = gui.add_slider("fit", 0, 1, 1, 0)
        self.words = gui.add_markdown("")
        self.play = gui.add_checkbox("play the fits", initial_value=False)
        self.drive = gui.add_checkbox("let the cars drive", initial_value=False)
        with gui.add_folder("Layers", expand_by_default=False):
            self.layers = {
                name: gui.add_checkbox(label, initial_value=shown) for name, label, shown in LAYERS
            }
        self.on_scrub(self.fit, lambda _: self._redraw())
        for layer in self.layers.values():
            layer.on_update(lambda _: self._apply_layers())

    def _show(self, choice: RoadChoice, *, obey: bool) -> None:
        newest = (run.run_id for run in self.store.runs() if run.env == ROAD)
        self._runs = choice.runs or tuple(newest)[:1]
        steps = {step for name in self._runs for step in road.steps(self.store.run(name))}
        self._steps = sorted(steps)
        self.fit.max = max(len(self._steps) - 1, 1)
        self.fit.disabled = len(self._steps) < 2
        if choice.step in self._steps:
            self.fit.value = self._steps.index(choice.step)
        self._redraw()

    def _mode_changed(self) -> None:
        self._drawn = []

    def _tick(self, seconds: float) -> None:
        """Advance to the next fit if the fits play, in a loop, and move the cars."""
        self._since += seconds
        if self.play.value and len(self._steps) > 1 and self._since >= PLAY_S:
            self._since = 0.0
            self.fit.value = (int(self.fit.value) + 1) % len(self._steps)
            self._redraw()
        if self.drive.value:
            longest = max((each.longest for each in self._scenes), default=0)
            self._driven = (self._driven + seconds * STEPS_PER_S) % (longest + REST)
            self._drive()

    def _redraw(self) -> None:
        if not self._steps:
            return
        step = self._steps[min(int(self.fit.value), len(self._steps) - 1)]
        shown = [fit for run in self._runs if (fit := self._fit_of(run, step)) is not None]
        drawn = [(run, picture.step) for run, picture in shown]
        if drawn == self._drawn or not shown:
            return
        same = [run for run, _ in drawn] == [run for run, _ in self._drawn]
        with self.client.atomic():
            if same:
                for each, (_, picture) in zip(self._scenes, shown, strict=True):
                    each.update(picture)
            else:
                self._draw(shown)
            self._apply_layers()
            self._drive()
        self._drawn = drawn
        self.words.content = f"the record of step **{step:,}**"

    def _fit_of(self, run_id: str, step: int) -> tuple[str, Picture] | None:
        """A run's fit at `step`, else the last one before; None if it was deleted or damaged."""
        try:
            run = self.store.run(run_id)
        except UserError:
            return None
        steps = road.steps(run)
        picture = road.picture(run, at_or_before(steps, step)) if steps else None
        return None if picture is None else (run_id, picture)

    def _draw(self, shown: list[tuple[str, Picture]]) -> None:
        if len(shown) != len(self._scenes):
            camera = self.client.camera
            high = camera.image_height  # 0 in a tab that was never in front
            aspect = camera.image_width / high if high else scene.ASPECT
            self.look(*scene.view(len(shown), camera.fov, aspect))
        self.clear()
        called = told_apart([self.store.run(run) for run, _ in shown])
        self._scenes = [
            RoadScene(self.client.scene, picture, self.mode, i, called[run])
            for i, (run, picture) in enumerate(shown)
        ]

    def _drive(self) -> None:
        for each in self._scenes:
            each.drive(self._driven)

    def _apply_layers(self) -> None:
        with self._lock:
            for each in self._scenes:
                each.show({name: bool(box.value) for name, box in self.layers.items()})


def as_html(fits: Sequence[Sequence[Picture]], mode: Mode, called: Sequence[str] = ()) -> str:
    """The pictures of R runs at F fits, (F, R), as a self-contained page.

    `called`: a name for each run (R,), by default its learner's.

    Its timeline shows the fits one after another; in each the cars drive their whole way. It is
    made by a temporary viser server in this process.
    """
    server = viser.ViserServer(HERE, free_port(HERE), verbose=False)
    try:
        server.scene.set_up_direction("+z")
        server.scene.configure_environment_map(None)
        stage(server.scene, mode, front=0.5)
        server.scene.world_axes.visible = False
        camera = server.initial_camera
        camera.position, camera.look_at = scene.view(len(fits[0]), camera.fov)
        names = called or [""] * len(fits[0])
        scenes = [
            RoadScene(server.scene, picture, mode, i, name)
            for i, (picture, name) in enumerate(zip(fits[0], names, strict=True))
        ]
        _show(scenes, fits[0])
        film = server.get_scene_serializer()
        for number, fit in enumerate(fits):
            if number:
                _show(scenes, fit)
            for step in range(0, max(each.longest for each in scenes) + STRIDE, STRIDE):
                for each in scenes:
                    each.drive(step)
                film.insert_sleep(FRAME_S)
            film.insert_sleep(REST_S)
        return film.as_html(dark_mode=mode == "dark")
    finally:
        server.stop()


def _show(scenes: Sequence[RoadScene], fit: Sequence[Picture]) -> None:
    for each, picture in zip(scenes, fit, strict=True):
        each.update(picture)
        each.show({name: shown for name, _, shown in LAYERS})
