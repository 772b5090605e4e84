"""An episode in 3D: the recorded robot, the model's prediction as a ghost, and how it is played."""

import numpy as np
import viser
from numpy.typing import NDArray

from app.data import replays
from app.data.replays import Replay
from app.scenes import solids
from app.scenes.control import REAL_TIME, SPEEDS, Clock, ReplayChoice
from app.scenes.frame import Frame, Vector, floor, under
from app.scenes.road import draw_map
from app.scenes.solids import Robot, Solids
from app.theme import Mode, learner_colour, rgb
from tom.envs import ENVS
from tom.envs import scene as geometry
from tom.errors import UserError

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
    def covered(self) -> tuple[Vector, float]:
        """Centre and extent of the robot's parts in the first frame, over the origin."""
        parts = self._real.position[0] - self._real.root[0] * (1.0, 1.0, 0.0)
        middle = np.median(parts, axis=0).astype(np.float32)
        x, y, z = middle.tolist()
        return (x, y, z), float(np.quantile(np.linalg.norm(parts - middle, axis=-1), 0.9))

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


class ReplayFrame(Frame):
    """Plays one episode, with the ghost beside the robot; the page has all other controls."""

    title = "Replay"
    shadows = True
    fill = 1.5

    def _build_panel(self) -> None:
        self._drawn: tuple[Replay, ReplayScene] | None = None
        self._choice: ReplayChoice | None = None
        self._at, self._asked = 0.0, 0
        self.playing = False
        self.play = self.client.gui.add_button("Play", icon=viser.Icon.PLAYER_PLAY)
        self.frame = self.client.gui.add_slider("step", 0, 1, 1, 0)
        self.play.on_click(lambda _: self._toggle())
        self.on_scrub(self.frame, self._pose)

    def _show(self, choice: ReplayChoice, *, obey: bool) -> None:
        run = self.store.run(choice.run)
        replay = replays.load(run, choice.step, choice.episode, choice.horizon)
        if replay is None:
            raise UserError(f"episode {choice.episode + 1} of step {choice.step} cannot be read")
        if not replay.drawn:
            raise UserError(f"there is nothing to draw of {run.env}: its curves are on the page")
        at = choice.frame if self._choice is None else self._at
        self._choice = choice
        if self._drawn is None or self._drawn[0] is not replay:
            self._draw(replay)
        if obey and choice.wish in ("go", "start"):
            at = choice.frame
        self._pose(at)
        if obey and choice.wish != "go" and self.playing != (choice.wish != "pause"):
            self._toggle()
        self._asked = choice.asked

    def clock(self) -> Clock:
        """The state of playback."""
        asked = self._asked  # read first: the rest may already be the outcome of a later request
        return Clock(int(self._at), self.playing, asked)

    def _mode_changed(self) -> None:
        self._drawn = None

    def _draw(self, replay: Replay) -> None:
        other = self._drawn is None or self._drawn[0].env != replay.env
        with self.client.atomic():
            self.clear()
            scene = ReplayScene(self.client.scene, replay, self.mode)
        self._drawn = replay, scene
        if other:
            self.look(*_view(replay, scene))
        self.frame.max = replay.episode.length

    def _toggle(self) -> None:
        with self._lock:
            self.playing = not self.playing
            self.play.label = "Pause" if self.playing else "Play"
            self.play.icon = viser.Icon.PLAYER_PAUSE if self.playing else viser.Icon.PLAYER_PLAY
            if self.playing and self._at >= self.frame.max:
                self._pose(0)

    def _tick(self, seconds: float) -> None:
        if self.playing and self._drawn and self._choice:
            speed = SPEEDS.get(self._choice.speed, SPEEDS[REAL_TIME])
            self._pose(self._at + seconds * speed / self._drawn[0].dt)
            if self._at >= self.frame.max:
                self._toggle()

    def _pose(self, at: float) -> None:
        """Show a frame, or the last one if the episode is shorter."""
        self._at = float(np.clip(at, 0, self.frame.max))
        self.frame.value = int(self._at)
        if self._drawn and self._choice:
            _, scene = self._drawn
            with self.client.atomic():
                scene.pose(int(self._at), follow=self._choice.follow)
                if scene.ghost is not None:
                    scene.ghost.visible = self._choice.ghost


def _view(replay: Replay, scene: ReplayScene) -> tuple[Vector, Vector]:
    """The camera's position and target."""
    if replay.road:
        return (0.5, -0.4, 1.25), (0.5, 0.42, 0.0)
    if replay.env in ENVS:
        away = 1.6 + 0.9 * scene.height
        return (0.45 * away, -away, 0.5 + 0.6 * scene.height), (0.0, 0.0, 0.5 * scene.height)
    # An unknown robot: from its extent in the first frame.
    (x, y, z), span = scene.covered
    away = 0.8 + 1.1 * span
    return (x + 0.45 * away, y - away, z + 0.6 * away), (x, y, z)
