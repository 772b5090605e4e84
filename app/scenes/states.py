"""Robots in heavy and light states of a replay buffer, each moving through its window of steps."""

from collections.abc import Sequence

import numpy as np
import viser
from numpy.typing import NDArray

from app.data import buffer, weighings
from app.data.buffer import WINDOW, poses, windows
from app.figures.base import OCTAVES, octaves
from app.scenes import solids
from app.scenes.control import SPEEDS, StatesChoice
from app.scenes.frame import Frame, add_words, floor
from app.scenes.solids import Colour, Robot, Solids
from app.theme import COLUMNS, Mode, on_scale
from tom import readable
from tom.envs.scene import Model
from tom.errors import UserError
from tom.record.reader import RunReader
from tom.record.store import Store
from tom.record.task_record import scene_of, task_of

ABREAST = 3
"""robots in a line"""
LETTERS = 0.2
"""height of letters relative to the area of a robot and its margin"""
TILT = 1.2
"""tilt of words, which lean back a little because the camera looks down"""
MARGIN = 0.45
"""metres between two robots"""
SLOW = tuple(name for name, speed in SPEEDS.items() if speed <= 1)


def places(count: int, size: NDArray, side: int) -> NDArray[np.float32]:
    """The positions (R, 3) of the robots of a side: lines of ABREAST, away from the middle.

    `side` is -1 for the left and 1 for the right; `size` (2,) is a robot's extent in x and y.
    """
    step = size + MARGIN
    column, line = np.arange(count) % ABREAST, np.arange(count) // ABREAST
    x = side * (column + 0.75) * step[0]
    return np.stack([x, line * step[1], np.zeros(count)], -1).astype(np.float32)


def footprint(groups: Sequence[Solids]) -> NDArray[np.float64]:
    """The extent of nearly all robots on the ground, (2,) metres in x and y, at least 0.6."""
    sizes = [np.ptp(one.position[:, WINDOW, :, :2], axis=1) for one in groups]
    spans = np.concatenate(sizes) if sizes else np.zeros((1, 2))
    return np.quantile(spans, 0.9, axis=0).clip(0.6) + 0.2


class StatesScene:
    """The scene nodes of two groups of robots; `pose` moves them through their windows."""

    def __init__(
        self, scene: viser.SceneApi, groups: Sequence[tuple[str, Solids, list[Colour]]], mode: Mode
    ) -> None:
        """`groups` are left and right: the title, the robots, a colour for each."""
        floor(scene, groups[-1][1].floor if groups else 0.0, mode)
        self.size = footprint([one for _, one, _ in groups])
        self._robots: list[tuple[Robot, Solids, NDArray[np.float32]]] = []
        for (words, one, colours), side in zip(groups, (-1, 1), strict=False):
            at = places(len(colours), self.size, side)
            name = "left" if side < 0 else "right"
            self._robots.append((Robot(scene, f"/{name}", one.meshes, colours), one, at))
            top = float(one.position[:, WINDOW, :, 2].max()) + 0.35
            foot = (float(at[:, 0].mean()), float(at[:, 1].max()), top)
            letters = LETTERS * float(self.size[0] + MARGIN)
            add_words(scene, f"/{name} label", words, mode, foot, letters, TILT)

    def pose(self, at: int) -> None:
        """Show frame `at` of every window; WINDOW is the middle."""
        for robot, one, place in self._robots:
            robot.pose(one.position[:, at] + place[:, None], one.wxyz[:, at])


class StatesFrame(Frame):
    """Heavy transitions on the left, light ones on the right, all of them moving."""

    title = "Heavy and light"
    shadows = True
    fill = 1.5

    def _build_panel(self) -> None:
        self._scene: StatesScene | None = None
        self._choice: StatesChoice | None = None
        self._env, self._dt = "", 0.01
        self._at = float(WINDOW)
        gui = self.client.gui
        self.play = gui.add_checkbox("play the moments", initial_value=False)
        self.offset = gui.add_slider("steps around", -WINDOW, WINDOW, 1, 0)
        self.speed = gui.add_dropdown("speed", SLOW, initial_value="1/4")
        gui.add_markdown("The colour is the weight: orange counts more than average, blue less.")
        self.on_scrub(self.offset, lambda offset: self._pose(offset + WINDOW))

    def _show(self, choice: StatesChoice, *, obey: bool) -> None:
        if choice == self._choice:
            return
        run = reader_of(str(self.store.path), choice.run)
        model = scene_of(run)
        if model is None:
            raise UserError(f"nothing to draw of {run.env}: its states are curves on the page")
        groups = _groups(run, choice, model, self.mode)
        with self.client.atomic():
            self.clear()
            self._scene = StatesScene(self.client.scene, groups, self.mode)
            self._pose(self._at)
        if run.env != self._env:
            self._env, self._dt = run.env, model.dt
            height = groups[-1][1].floor if groups else 0.0
            width, depth = 3.6 * (self._scene.size + MARGIN)
            away = 0.5 * width + 0.4
            self.look((0.1, -away, height + 1.0 + 0.35 * away), (0.1, 0.3 * depth, height + 0.5))
        self._choice = choice

    def _mode_changed(self) -> None:
        self._choice = None

    def _tick(self, seconds: float) -> None:
        if self.play.value and self._scene is not None:
            step = seconds * SPEEDS[self.speed.value] / self._dt
            self._pose((self._at + step) % (2 * WINDOW + 1))
            self.offset.value = int(self._at) - WINDOW

    def _pose(self, at: float) -> None:
        self._at = at
        if self._scene is not None:
            with self.client.atomic():
                self._scene.pose(int(at))


def reader_of(store: str, name: str) -> RunReader:
    """The run or data set `name`. Raises UserError if there is none."""
    try:
        return Store(store).run(name)
    except UserError:
        return weighings.dataset(store, name)


def _groups(
    run: RunReader, choice: StatesChoice, model: Model, mode: Mode
) -> list[tuple[str, Solids, list[Colour]]]:
    """The title, the robots and their colours of each group that has rows."""
    recorded, _, state, _ = buffer.recorded(run)
    ended = recorded.ended()
    if max((*choice.heavy, *choice.light), default=0) >= len(ended):
        raise UserError("these transitions are no longer in the run's record")
    groups = []
    for words, rows, weights in (
        (choice.titles[0], choice.heavy, choice.heavy_weights),
        (choice.titles[1], choice.light, choice.light_weights),
    ):
        if rows:
            qpos = poses(task_of(run), recorded, state, windows(ended, rows))
            ends = dict.fromkeys(readable.short(weight) for weight in (min(weights), max(weights)))
            share = octaves(np.array(weights, np.float64)) / (2 * OCTAVES) + 0.5
            colours = [(int(r), int(g), int(b)) for r, g, b in on_scale(share, COLUMNS[mode])]
            groups.append((f"{words}: weight {' to '.join(ends)}", solids.of(model, qpos), colours))
    return groups
