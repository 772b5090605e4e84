"""Robots in states of a replay buffer: two groups, each robot moving through its window."""

from collections.abc import Sequence

import numpy as np
import viser
from numpy.typing import NDArray

from app.data.buffer import WINDOW
from app.scenes.solids import Colour, Floats, Robot, Solids
from app.scenes.stage import floor, sky
from app.scenes.words import add_words
from app.theme import Mode
from tom.data.transitions import Transitions
from tom.envs.task import Task

ABREAST = 3
"""robots in a line"""
LETTERS = 0.2
"""height of letters relative to the area of a robot and its margin"""
TILT = 1.2
"""tilt of words, which lean back a little because the camera looks down"""
MARGIN = 0.45
"""metres between two robots"""


def poses(
    known: Task, recorded: Transitions, state: dict[str, NDArray], rows: NDArray[np.int64]
) -> Floats:
    """Joint positions (R, W, nq) of the recorded states at row numbers (R, W).

    Positions on the ground are relative to the middle of each robot's window; without the
    simulator's state a robot stays at the origin.
    """
    if "qpos" in state:
        qpos = state["qpos"][rows].astype(np.float32)
        roots = known.root_dims or 0
        qpos[..., :roots] -= qpos[:, WINDOW : WINDOW + 1, :roots]
        return qpos
    return known.qpos_from_obs(np.asarray(recorded.obs, np.float32)[rows])


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
        self,
        scene: viser.SceneApi,
        groups: Sequence[tuple[str, Solids, Sequence[Colour]]],
        height: float,
        mode: Mode,
    ) -> None:
        """`groups` are left and right: the title, the robots, a colour for each."""
        sky(scene, mode)
        floor(scene, height, mode)
        self.size = footprint([one for _, one, _ in groups])
        self._robots: list[tuple[Robot, Solids, NDArray[np.float32]]] = []
        for (words, one, colours), side in zip(groups, (-1, 1), strict=False):
            at = places(len(colours), self.size, side)
            name = "left" if side < 0 else "right"
            self._robots.append((Robot(scene, f"/{name}", one.meshes, colours), one, at))
            middle = at.mean(0)
            top = float(one.position[:, WINDOW, :, 2].max()) + 0.35
            foot = (float(middle[0]), float(at[:, 1].max()), top)
            letters = LETTERS * float(self.size[0] + MARGIN)
            label = f"/{name} label"
            add_words(scene, label, words, mode, foot, letters, TILT)

    def pose(self, at: int) -> None:
        """Show frame `at` of every window; WINDOW is the middle."""
        for robot, one, place in self._robots:
            robot.pose(one.position[:, at] + place[:, None], one.wxyz[:, at])
