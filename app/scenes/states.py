"""Robots in states of a replay buffer: two groups in rows, each robot moving through its moment."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import viser
from numpy.typing import NDArray

from app.scenes import solids
from app.scenes.robot import Robot
from app.scenes.solids import Solids
from app.scenes.stage import floor, sky
from app.scenes.words import Words, add_words
from app.theme import Mode
from tom.data.transitions import Transitions
from tom.envs import scene as geometry
from tom.envs import task

ABREAST = 3
"""robots in a line"""
WINDOW = 12
"""steps shown before and after the moment"""
LETTERS = 0.2
"""height of letters, as a share of what a robot and its margin cover"""
TILT = 1.2
"""words stand, leaning a little back, as the camera looks down a little"""
MARGIN = 0.45
"""metres between two robots"""

Floats = NDArray[np.float32]


def moments(ended: NDArray[np.bool_], rows: Sequence[int]) -> NDArray[np.int64]:
    """The row numbers (R, 2 WINDOW + 1) round each of R rows, held at its episode's ends."""
    last = np.flatnonzero(ended)
    found = []
    for row in rows:
        before = last[last < row]
        after = last[last >= row]
        low = int(before[-1]) + 1 if len(before) else 0
        high = int(after[0]) if len(after) else len(ended) - 1
        found.append(np.clip(np.arange(row - WINDOW, row + WINDOW + 1), low, high))
    return np.array(found, np.int64).reshape(len(rows), 2 * WINDOW + 1)


def poses(
    env: str, recorded: Transitions, state: dict[str, NDArray], rows: NDArray[np.int64]
) -> Floats:
    """Joint positions (R, W, nq) of the recorded states at row numbers (R, W).

    Each robot's place on the ground is taken from its moment, the middle of its window; where the
    simulator's state was not kept it stays at the origin.
    """
    known = task(env)
    if "qpos" in state:
        qpos = state["qpos"][rows].astype(np.float32)
        qpos[..., : known.root_dims] -= qpos[:, WINDOW : WINDOW + 1, : known.root_dims]
        return qpos
    return known.qpos_from_obs(np.asarray(recorded.obs, np.float32)[rows])


@dataclass(frozen=True)
class Group:
    """R robots of one side: their parts over W frames."""

    solids: Solids  # position (W, R, G, 3) flattened over frames and robots
    count: int

    def frame(self, at: int) -> tuple[Floats, Floats]:
        """Position (R, G, 3) and orientation (R, G, 4) of every part at frame `at`."""
        width = 2 * WINDOW + 1
        places = self.solids.position.reshape(self.count, width, -1, 3)
        turns = self.solids.wxyz.reshape(self.count, width, -1, 4)
        return places[:, at], turns[:, at]


def group(env: str, qpos: Floats) -> tuple[Group, float]:
    """R robots along joint positions (R, W, nq), and the floor's height."""
    count = len(qpos)
    found = geometry.geometry(geometry.model(env).mj, qpos.reshape(-1, qpos.shape[-1]))
    height = found.floor
    if height is None:
        height = float(found.capsules.center[..., 2].min()) - 0.5
    return Group(solids.of(found), count), height


def places(count: int, size: NDArray, side: int) -> NDArray[np.float32]:
    """Where the robots of a side stand, (R, 3): lines of ABREAST away from the middle.

    `side` is -1 for the left and 1 for the right; `size` (2,) is what a robot covers in x and y.
    """
    step = size + MARGIN
    column, line = np.arange(count) % ABREAST, np.arange(count) // ABREAST
    x = side * (column + 0.75) * step[0]
    return np.stack([x, line * step[1], np.zeros(count)], -1).astype(np.float32)


def footprint(groups: Sequence[Group]) -> NDArray[np.float64]:
    """What nearly every robot covers on the ground, (2,) metres in x and y, at least 0.6."""
    sizes = []
    for one in groups:
        sizes.append(np.ptp(one.frame(WINDOW)[0][..., :2], axis=1))
    spans = np.concatenate(sizes) if sizes else np.zeros((1, 2))
    return np.quantile(spans, 0.9, axis=0).clip(0.6) + 0.2


class StatesScene:
    """The nodes of two groups of robots; `pose` moves them through their moments."""

    def __init__(
        self,
        scene: viser.SceneApi,
        groups: Sequence[tuple[str, Group, Sequence[tuple[int, int, int]]]],
        height: float,
        mode: Mode,
    ) -> None:
        """`groups` are left and right: what stands above, the robots, a colour for each."""
        sky(scene, mode)
        floor(scene, height, mode)
        self.size = footprint([one for _, one, _ in groups])
        self.words: list[Words] = []
        self._robots: list[tuple[Robot, Group, NDArray[np.float32]]] = []
        for (words, one, colours), side in zip(groups, (-1, 1), strict=False):
            at = places(one.count, self.size, side)
            name = "left" if side < 0 else "right"
            self._robots.append((Robot(scene, f"/{name}", one.solids, colours), one, at))
            middle = at.mean(0)
            top = float(one.frame(WINDOW)[0][..., 2].max()) + 0.35
            foot = (float(middle[0]), float(at[:, 1].max()), top)
            letters = LETTERS * float(self.size[0] + MARGIN)
            label = f"/{name} label"
            self.words.append(add_words(scene, label, words, mode, foot, letters, TILT))

    def pose(self, at: int) -> None:
        """Show frame `at` of every moment; WINDOW is the moment itself."""
        for robot, one, place in self._robots:
            position, wxyz = one.frame(at)
            robot.pose((position + place[:, None]).astype(np.float32), wxyz)
