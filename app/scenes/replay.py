"""An episode in 3D: the robot as it was, the model's imagination as a ghost."""

from dataclasses import dataclass

import numpy as np
import viser
from numpy.typing import NDArray

from app.data.pictures import ENV as ROAD
from app.data.replays import Replay
from app.scenes import solids
from app.scenes.colours import rgb
from app.scenes.road import draw_map
from app.scenes.robot import Robot
from app.scenes.solids import Solids
from app.scenes.stage import floor, sky, under
from app.scenes.words import Words
from app.theme import Mode, learner_colour
from tom.envs import scene as geometry

REAL: dict[Mode, str] = {"light": "#5b6577", "dark": "#aeb7c8"}
GHOST_OPACITY = 0.45


@dataclass(frozen=True)
class Track:
    """One robot's parts over an episode, and where its root is."""

    solids: Solids
    root: NDArray[np.float32]  # (H + 1, 3)
    floor: float  # metres


def track(env: str, qpos: NDArray) -> Track:
    """A MuJoCo task's robot along joint positions (H + 1, nq), or a car along places (H + 1, 2)."""
    if env == ROAD:
        driven = solids.car(qpos)
        return Track(driven, driven.position[:, 0], 0.0)
    found = geometry.geometry(geometry.model(env).mj, qpos)
    return Track(
        solids.of(found), found.root, _lowest(found) if found.floor is None else found.floor
    )


def _lowest(found: geometry.Geometry) -> float:
    return float(found.capsules.center[..., 2].min()) - 0.5


class ReplayScene:
    """The nodes of one episode; `pose` puts them to a frame."""

    def __init__(self, scene: viser.SceneApi, replay: Replay, mode: Mode) -> None:
        self._real = track(replay.env, replay.real)
        self._ghost = None if replay.ghost is None else track(replay.env, replay.ghost)
        sky(scene, mode)
        self._floor = None if replay.road else floor(scene, self._real.floor, mode)
        self.words: list[Words] = []
        if replay.road:
            self.words = draw_map(scene, replay.road, mode)
        self.robot = Robot(scene, "/real", self._real.solids, [rgb(REAL[mode])])
        self.ghost = None
        if self._ghost is not None:
            colour = rgb(learner_colour(replay.learner))
            self.ghost = Robot(scene, "/ghost", self._ghost.solids, [colour], GHOST_OPACITY)

    @property
    def height(self) -> float:
        """How high above the floor the robot's root is at first."""
        return float(self._real.root[0, 2] - self._real.floor)

    def pose(self, frame: int, *, follow: bool) -> None:
        """Show step `frame`; `follow` keeps the real robot over the origin."""
        place = np.zeros(3)
        if self._floor is not None and follow:
            place = self._real.root[frame] * (1.0, 1.0, 0.0)
            self._floor.position = under(place, self._real.floor)
        for robot, of in ((self.robot, self._real), (self.ghost, self._ghost)):
            if robot is not None and of is not None:
                shifted = (of.solids.position[frame] - place).astype(np.float32)
                robot.pose(shifted[None], of.solids.wxyz[frame][None])
