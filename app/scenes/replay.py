"""An episode in 3D: the recorded robot, and the model's prediction as a ghost."""

import numpy as np
import viser
from numpy.typing import NDArray

from app.data.replays import Replay
from app.scenes import solids
from app.scenes.colours import rgb
from app.scenes.road import draw_map
from app.scenes.solids import Robot, Solids
from app.scenes.stage import floor, sky, under
from app.theme import Mode, learner_colour
from tom.envs import scene as geometry

REAL: dict[Mode, str] = {"light": "#5b6577", "dark": "#aeb7c8"}
GHOST_OPACITY = 0.45
ASIDE = np.array([0.0, -0.03, 0.0])
"""metres from the real robot to its ghost, towards the camera, because coinciding surfaces
would flicker"""


def track(model: geometry.Model | None, qpos: NDArray) -> Solids:
    """A MuJoCo task's robot at joint positions (H + 1, nq).

    Without a model it is road-and-rocks' car at positions (H + 1, 2).
    """
    return solids.car(qpos) if model is None else solids.of(model, qpos)


class ReplayScene:
    """The scene nodes of one episode; `pose` sets them to a frame."""

    def __init__(self, scene: viser.SceneApi, replay: Replay, mode: Mode) -> None:
        self._real = track(replay.model, replay.real)
        self._ghost = None if replay.ghost is None else track(replay.model, replay.ghost)
        sky(scene, mode)
        self._floor = None if replay.road else floor(scene, self._real.floor, mode)
        if replay.road:
            draw_map(scene, replay.road, mode)
        self.robot = Robot(scene, "/real", self._real.meshes, [rgb(REAL[mode])])
        self.ghost = None
        if self._ghost is not None:
            colour = rgb(learner_colour(replay.learner))
            self.ghost = Robot(scene, "/ghost", self._ghost.meshes, [colour], GHOST_OPACITY)

    @property
    def height(self) -> float:
        """The height of the robot's root above the floor in the first frame."""
        return float(self._real.root[0, 2] - self._real.floor)

    @property
    def covered(self) -> tuple[NDArray[np.float32], float]:
        """Centre (3,) and extent of the robot's parts in the first frame, over the origin."""
        parts = self._real.position[0] - self._real.root[0] * (1.0, 1.0, 0.0)
        middle = np.median(parts, axis=0).astype(np.float32)
        return middle, float(np.quantile(np.linalg.norm(parts - middle, axis=-1), 0.9))

    def pose(self, frame: int, *, follow: bool) -> None:
        """Show step `frame`; with `follow` the real robot stays over the origin."""
        place = np.zeros(3)
        if self._floor is not None and follow:
            place = self._real.root[frame] * (1.0, 1.0, 0.0)
            self._floor.position = under(place, self._real.floor)
        for robot, of, aside in (
            (self.robot, self._real, 0.0),
            (self.ghost, self._ghost, ASIDE),
        ):
            if robot is not None and of is not None:
                shifted = (of.position[frame] - place + aside).astype(np.float32)
                robot.pose(shifted[None], of.wxyz[frame][None])
