"""An episode in 3D: the recorded robot, the model's prediction as a ghost, and how it is played."""

import numpy as np
import viser

from app.data import replays
from app.data.readers import folder_reader
from app.data.replays import Replay
from app.scenes import solids
from app.scenes.control import REAL_TIME, SPEEDS, Clock, ReplayChoice
from app.scenes.frame import SECTION, Frame, Vector, floor
from app.scenes.road import draw_map
from app.scenes.solids import Robot, Solids
from app.theme import REAL, learner_colour, rgb
from tom.envs import ENVS
from tom.errors import UserError

GHOST_OPACITY = 0.45
GHOST_OFFSET = np.array([0.0, -0.03, 0.0])
"""metres from the real robot to its ghost, towards the camera, because coinciding surfaces
would flicker"""


class ReplayFrame(Frame):
    """Plays one episode, with the ghost beside the robot; the page has all other controls."""

    title = "Replay"
    shadows = True
    fill = 1.5

    def _build_panel(self) -> None:
        self._replay: Replay | None = None
        self._choice: ReplayChoice | None = None
        self._at, self._asked = 0.0, 0
        self.playing = False
        self.play = self.client.gui.add_button("Play", icon=viser.Icon.PLAYER_PLAY)
        self.frame = self.client.gui.add_slider("step", 0, 1, 1, 0)
        self.play.on_click(lambda _: self._toggle())
        self.on_scrub(self.frame, self._pose)

    def _show(self, choice: ReplayChoice, *, obey: bool) -> None:
        run = folder_reader(choice.run)
        replay = replays.load(run, choice.step, choice.episode, choice.horizon)
        if replay is None:
            raise UserError(f"episode {choice.episode + 1} of step {choice.step} cannot be read")
        if not replay.has_scene:
            raise UserError(f"there is nothing to draw of {run.env}: its curves are on the page")
        at = choice.frame if self._choice is None else self._at
        self._choice = choice
        if self._drawn is not replay:
            self._draw(replay)
        if obey and choice.command in ("go", "start"):
            at = choice.frame
        self._pose(at)
        if obey and choice.command != "go" and self.playing != (choice.command != "pause"):
            self._toggle()
        self._asked = choice.request

    def clock(self) -> Clock:
        """The state of playback."""
        asked = self._asked  # read first: the rest may already be the outcome of a later request
        return Clock(int(self._at), self.playing, asked)

    def _draw(self, replay: Replay) -> None:
        scene, real, self._ghost = (
            self.client.scene,
            solids.robot_solids(replay.model, replay.real),
            None,
        )
        with self.client.atomic():
            self.clear()
            if replay.road:
                draw_map(scene, replay.road, self.mode)
            self._floor = None if replay.road else floor(scene, real.floor, self.mode)
            self._robot = Robot(scene, "/real", real, [rgb(REAL[self.mode])])
            if replay.ghost is not None:
                ghost, colour = (
                    solids.robot_solids(replay.model, replay.ghost),
                    learner_colour(replay.learner),
                )
                self._ghost = Robot(scene, "/ghost", ghost, [rgb(colour)], GHOST_OPACITY)
        other = self._replay is None or self._replay.env != replay.env
        self._replay = self._drawn = replay
        if other:
            self.set_camera(*_camera(replay, real))
        self.frame.max = replay.episode.length

    def _toggle(self) -> None:
        with self._lock:
            self.playing = not self.playing
            self.play.label = "Pause" if self.playing else "Play"
            self.play.icon = viser.Icon.PLAYER_PAUSE if self.playing else viser.Icon.PLAYER_PLAY
            if self.playing and self._at >= self.frame.max:
                self._pose(0)

    def _tick(self, seconds: float) -> None:
        if self.playing and self._replay and self._choice:
            speed = SPEEDS.get(self._choice.speed, SPEEDS[REAL_TIME])
            self._pose(self._at + seconds * speed / self._replay.dt)
            if self._at >= self.frame.max:
                self._toggle()

    def _pose(self, at: float) -> None:
        """Show a frame, or the last one if the episode is shorter.

        If the camera follows, the real robot stays over the origin.
        """
        self._at = float(np.clip(at, 0, self.frame.max))
        self.frame.value = frame = int(self._at)
        if self._replay is None or self._choice is None:
            return
        with self.client.atomic():
            place, real = np.zeros(3), self._robot.solids
            if self._floor is not None and self._choice.follow:
                place = real.root[frame] * (1.0, 1.0, 0.0)
                x, y = -np.mod(place[:2], SECTION)
                self._floor.position = float(x), float(y), real.floor
            self._robot.pose(frame, -place)
            if self._ghost is not None:
                self._ghost.pose(frame, GHOST_OFFSET - place)
                self._ghost.node.visible = self._choice.ghost


def _camera(replay: Replay, real: Solids) -> tuple[Vector, Vector]:
    """The camera's position and target."""
    if replay.road:
        return (0.5, -0.4, 1.25), (0.5, 0.42, 0.0)
    if replay.env in ENVS:
        height = float(real.root[0, 2] - real.floor)
        away = 1.6 + 0.9 * height
        return (0.45 * away, -away, 0.5 + 0.6 * height), (0.0, 0.0, 0.5 * height)
    # An unknown robot: from its extent in the first frame.
    parts = real.position[0] - real.root[0] * (1.0, 1.0, 0.0)
    middle = np.median(parts, axis=0)
    x, y, z = middle.tolist()
    away = 0.8 + 1.1 * float(np.quantile(np.linalg.norm(parts - middle, axis=-1), 0.9))
    return (x + 0.45 * away, y - away, z + 0.6 * away), (x, y, z)
