"""An episode in 3D: the recorded robot, the model's prediction as a ghost, and how it is played."""

import numpy as np
import viser
from numpy.typing import NDArray

from app.data import replays
from app.data.replays import Replay
from app.scenes import solids
from app.scenes.control import REAL_TIME, SPEEDS, Clock, ReplayChoice, Selection
from app.scenes.frame import Frame, Vector, floor, sky, under
from app.scenes.road import draw_map
from app.scenes.solids import Robot, Solids
from app.theme import Mode, learner_colour, rgb
from tom.envs import ENVS
from tom.envs import scene as geometry
from tom.errors import UserError
from tom.record.store import Store

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


class ReplayFrame(Frame):
    """Plays one episode, with the ghost beside the robot; the page has all other controls."""

    title = "Replay"
    shadows = True
    fill = 1.5

    def _build_panel(self) -> None:
        self._replay: Replay | None = None
        self._scene: ReplayScene | None = None
        self._choice: ReplayChoice | None = None
        self._at, self._asked = 0.0, 0
        self.playing = False
        self.play = self.client.gui.add_button("Play", icon=viser.Icon.PLAYER_PLAY)
        self.frame = self.client.gui.add_slider("step", 0, 1, 1, 0)
        self.play.on_click(lambda _: self._toggle())
        self.frame.on_update(self._scrubbed)

    def _show(self, selection: Selection, *, obey: bool) -> None:
        choice = selection.choice
        assert isinstance(choice, ReplayChoice)
        run = Store(self.store).run(choice.run)
        replay = replays.load(run, choice.step, choice.episode, choice.horizon)
        if replay is None:
            raise UserError(f"episode {choice.episode + 1} of step {choice.step} cannot be read")
        if not replay.drawn:
            raise UserError(f"there is nothing to draw of {run.env}: its curves are on the page")
        first, self._choice = self._choice is None, choice
        if replay is not self._replay:
            self._draw(replay)
        if first:
            self._go_to(choice.frame)
        if obey:
            self._obey(choice)
        self._asked = choice.asked
        self._pose()

    def _obey(self, choice: ReplayChoice) -> None:
        """Carry out the page's wish."""
        if choice.wish == "go":
            self._go_to(choice.frame)
            return
        if choice.wish == "start":
            self._go_to(0)
        if self.playing != (choice.wish != "pause"):
            self._toggle()

    def clock(self) -> Clock:
        """The state of playback."""
        asked = self._asked  # read first: the rest may already be the outcome of a later request
        return Clock(int(self._at), self.playing, asked)

    def _mode_changed(self) -> None:
        self._replay = None

    def _draw(self, replay: Replay) -> None:
        other = self._replay is None or self._replay.env != replay.env
        self._replay = replay
        with self.client.atomic():
            self.clear()
            self._scene = ReplayScene(self.client.scene, replay, self.mode)
        if other:
            self.look(*self._view(replay, self._scene))
        self.frame.max = replay.episode.length
        self._go_to(min(self._at, replay.episode.length))

    def _view(self, replay: Replay, scene: ReplayScene) -> tuple[Vector, Vector]:
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

    def _toggle(self) -> None:
        with self._lock:
            self.playing = not self.playing
            self.play.label = "Pause" if self.playing else "Play"
            self.play.icon = viser.Icon.PLAYER_PAUSE if self.playing else viser.Icon.PLAYER_PLAY
            if self.playing and self._replay and self._at >= self._replay.episode.length:
                self._go_to(0)

    def _scrubbed(self, event: viser.GuiEvent) -> None:
        if event.client is not None:  # moved by the user, not by playback
            with self._lock:
                self._at = float(self.frame.value)
                self._pose()

    def _go_to(self, frame: float) -> None:
        self._at = float(np.clip(frame, 0, self.frame.max))
        self.frame.value = int(self._at)

    def _tick(self, seconds: float) -> None:
        if not self.playing or self._replay is None or self._choice is None:
            return
        speed = SPEEDS.get(self._choice.speed, SPEEDS[REAL_TIME])
        self._go_to(self._at + seconds * speed / self._replay.dt)
        self._pose()
        if self._at >= self._replay.episode.length:
            self._toggle()

    def _pose(self) -> None:
        if self._scene is not None and self._choice is not None:
            with self.client.atomic():
                self._scene.pose(int(self._at), follow=self._choice.follow)
                if self._scene.ghost is not None:
                    self._scene.ghost.visible = self._choice.ghost
