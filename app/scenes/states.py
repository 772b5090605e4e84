"""Robots in heavy and light states of a replay buffer, each moving through its window of steps."""

import numpy as np
from numpy.typing import NDArray

from app.data import buffer
from app.data.buffer import WINDOW, poses, windows
from app.data.readers import folder_reader
from app.scenes import solids
from app.scenes.control import SPEEDS, StatesChoice
from app.scenes.frame import Frame, add_text, floor
from app.scenes.solids import Robot, Solids
from app.theme import Mode
from tom import readable
from tom.envs.scene import Model
from tom.errors import UserError
from tom.record.reader import RunReader
from tom.record.task_record import scene_of, task_of

ROBOTS_IN_LINE = 3
"""robots in a line"""
LETTERS = 0.2
"""height of letters relative to the area of a robot and its margin"""
TILT = 1.2
"""tilt of words, which lean back a little because the camera looks down"""
MARGIN = 0.45
"""metres between two robots"""
SLOW = tuple(name for name, speed in SPEEDS.items() if speed <= 1)


class StatesFrame(Frame):
    """Heavy transitions on the left, light ones on the right, all of them moving."""

    title = "Heavy and light"
    shadows = True
    fill = 1.5

    def _build_panel(self) -> None:
        self._robots: list[tuple[Robot, NDArray]] = []
        self._env, self._dt = "", 0.01
        self._at = float(WINDOW)
        gui = self.client.gui
        self.play = gui.add_checkbox("play the moments", initial_value=False)
        self.offset = gui.add_slider("steps around", -WINDOW, WINDOW, 1, 0)
        self.speed = gui.add_dropdown("speed", SLOW, initial_value="1/4")
        gui.add_markdown("The colour is the weight: orange counts more than average, blue less.")
        self.on_scrub(self.offset, lambda offset: self._pose(offset + WINDOW))

    def _show(self, choice: StatesChoice, *, obey: bool) -> None:
        if choice == self._drawn:
            return
        run = folder_reader(choice.run)
        model = scene_of(run)
        if model is None:
            raise UserError(f"nothing to draw of {run.env}: its states are curves on the page")
        groups = _groups(run, choice, model, self.mode)
        # The extent of nearly all robots on the ground, in x and y, with what keeps them apart.
        spans = [np.ptp(one.position[:, WINDOW, :, :2], axis=1) for _, one, _ in groups]
        size = np.quantile(np.concatenate(spans or [np.zeros((1, 2))]), 0.9, axis=0)
        size = size.clip(0.6) + 0.2 + MARGIN
        height = groups[-1][1].floor if groups else 0.0
        with self.client.atomic():
            self.clear()
            floor(self.client.scene, height, self.mode)
            self._robots = [
                self._group(*group, side, size)
                for group, side in zip(groups, (-1, 1), strict=False)
            ]
            self._pose(self._at)
        if run.env != self._env:
            self._env, self._dt = run.env, model.dt
            width, depth = size.tolist()
            away = 1.8 * width + 0.4
            self.set_camera(
                (0.0, -away, height + 1.0 + 0.35 * away), (0.0, 1.1 * depth, height + 0.5),
                corner=(-(ROBOTS_IN_LINE + 0.25) * width, -depth / 2, height),
            )  # fmt: skip
        self._drawn = choice

    def _group(
        self, words: str, robots: Solids, colours: NDArray[np.uint8], side: int, size: NDArray
    ) -> tuple[Robot, NDArray]:
        """The robots of a side, -1 for the left and 1 for the right, and their places (R, 1, 3).

        They stand in lines of ABREAST, away from the middle, `size` (2,) apart.
        """
        number = np.arange(len(colours))
        x, y = side * (number % ROBOTS_IN_LINE + 0.75) * size[0], number // ROBOTS_IN_LINE * size[1]
        name = "left" if side < 0 else "right"
        top = float(robots.position[:, WINDOW, :, 2].max()) + 0.35
        foot = (float(x.mean()), float(y.max()), top)
        letters, scene = LETTERS * float(size[0]), self.client.scene
        add_text(scene, f"/{name} label", words, self.mode, foot, letters, TILT)
        place = np.stack([x, y, np.zeros(len(x))], -1)[:, None]
        return Robot(scene, f"/{name}", robots, colours), place

    def _tick(self, seconds: float) -> None:
        if self.play.value and self._robots:
            step = seconds * SPEEDS[self.speed.value] / self._dt
            self._pose((self._at + step) % (2 * WINDOW + 1))
            self.offset.value = int(self._at) - WINDOW

    def _pose(self, at: float) -> None:
        self._at = at
        with self.client.atomic():
            for robot, place in self._robots:
                robot.pose(at, place)


def _groups(
    run: RunReader, choice: StatesChoice, model: Model, mode: Mode
) -> list[tuple[str, Solids, NDArray[np.uint8]]]:
    """The title, the robots and their colours of each group that has rows."""
    recorded, _, state, _ = buffer.recorded_with_states(run)
    ended = recorded.ended()
    if max((row for _, rows, _ in choice.groups for row in rows), default=0) >= len(ended):
        raise UserError("these transitions are no longer in the run's record")
    groups = []
    for words, rows, weights in choice.groups:
        if rows:
            qpos = poses(task_of(run), recorded, state, windows(ended, rows))
            ends = dict.fromkeys(
                "< 0.001" if 0 < weight < 0.001 else readable.short(weight)
                for weight in (min(weights), max(weights))
            )
            colours = solids.weight_colours(np.array(weights, np.float64), mode)
            title = f"{words}: weight {' to '.join(ends)}"
            groups.append((title, solids.robot_solids(model, qpos), colours))
    return groups
