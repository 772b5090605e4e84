"""The browser frame with robots in heavy and light states of a replay buffer."""

from collections.abc import Sequence

import numpy as np
import viser

from app.data import buffer, weighings
from app.data.buffer import WINDOW, windows
from app.figures.scales import OCTAVES, octaves
from app.scenes import solids, states
from app.scenes.colours import on_scale
from app.scenes.control import Selection, StatesChoice
from app.scenes.frame import Frame
from app.scenes.states import StatesScene
from app.scenes.words import Words
from app.theme import COLUMNS, Mode
from tom import readable
from tom.errors import UserError
from tom.record.reader import RunReader
from tom.record.store import Store
from tom.record.task_record import scene_of, task_of

SPEEDS = {"1/10": 0.1, "1/4": 0.25, "1/2": 0.5, "real time": 1.0}


def whose_rows(store: str, name: str) -> RunReader:
    """The run or data set `name`. Raises UserError if there is none."""
    if Store(store).has_folder(name):
        return Store(store).run(name)
    return weighings.dataset(store, name)


class StatesFrame(Frame):
    """Heavy transitions on the left, light ones on the right, all of them moving."""

    title = "Heavy and light"
    shadows = True
    fill = 1.5

    def _build_panel(self) -> None:
        self._scene: StatesScene | None = None
        self._drawn: StatesChoice | None = None
        self._env = ""
        self._dt = 0.01
        self._at = float(WINDOW)
        gui = self.client.gui
        self.play = gui.add_checkbox("play the moments", initial_value=False)
        self.offset = gui.add_slider("steps around", -WINDOW, WINDOW, 1, 0)
        self.speed = gui.add_dropdown("speed", tuple(SPEEDS), initial_value="1/4")
        gui.add_markdown("The colour is the weight: orange counts more than average, blue less.")
        self.offset.on_update(self._scrubbed)

    def _show(self, selection: Selection) -> None:
        choice = selection.choice
        assert isinstance(choice, StatesChoice)
        if choice == self._drawn:
            return
        run = whose_rows(self.store, choice.run)
        recorded, _, state = buffer.recorded(run)
        env, known, model = run.env, task_of(run), scene_of(run)
        if model is None:
            raise UserError(f"there is nothing to draw of {env}: its states are curves on the page")
        ended = recorded.ended()
        if max((*choice.heavy, *choice.light), default=0) >= len(ended):
            raise UserError("these transitions are no longer in the run's record")
        groups, height = [], 0.0
        for words, rows, weights in (
            ("heaviest", choice.heavy, choice.heavy_weights),
            ("lightest", choice.light, choice.light_weights),
        ):
            if rows:
                qpos = states.poses(known, recorded, state, windows(ended, rows))
                one = solids.of(model, qpos)
                height = one.floor
                groups.append((_label(words, weights), one, _colours(weights, self.mode)))
        self._draw(groups, height, env, model.dt)
        self._drawn = choice

    def _draw(self, groups: list, height: float, env: str, dt: float) -> None:
        with self.client.atomic():
            self.clear()
            self._scene = StatesScene(self.client.scene, groups, height, self.mode)
            self._pose()
        if env != self._env:
            self._env, self._dt = env, dt
            width, depth = 3.6 * (self._scene.size + states.MARGIN)
            away = 0.5 * width + 0.4
            self.look((0.1, -away, height + 1.0 + 0.35 * away), (0.1, 0.3 * depth, height + 0.5))

    def _mode_changed(self) -> None:
        self._drawn = None

    def _scrubbed(self, event: viser.GuiEvent) -> None:
        if event.client is not None:  # moved by the user, not by playback
            with self._lock:
                self._at = float(self.offset.value + WINDOW)
                self._pose()

    def _tick(self, seconds: float) -> None:
        if self.play.value and self._scene is not None:
            step = seconds * SPEEDS[self.speed.value] / self._dt
            self._at = (self._at + step) % (2 * WINDOW + 1)
            self.offset.value = int(self._at) - WINDOW
            self._pose()

    def _words(self) -> Sequence[Words]:
        return () if self._scene is None else self._scene.words

    def _pose(self) -> None:
        if self._scene is not None:
            with self.client.atomic():
                self._scene.pose(int(self._at))


def _label(words: str, weights: Sequence[float]) -> str:
    ends = dict.fromkeys(readable.short(weight) for weight in (min(weights), max(weights)))
    return f"{words}: weight {' to '.join(ends)}"


def _colours(weights: Sequence[float], mode: Mode) -> list[tuple[int, int, int]]:
    share = octaves(np.asarray(weights, np.float64)) / (2 * OCTAVES) + 0.5
    return [(int(r), int(g), int(b)) for r, g, b in on_scale(share, COLUMNS[mode])]
