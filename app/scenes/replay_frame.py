"""The browser frame that plays evaluation episodes."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import viser

from app.data import replays
from app.data.replays import Replay
from app.scenes.control import REAL_TIME, SPEEDS, Clock, ReplayChoice, Selection
from app.scenes.frame import Frame, Vector
from app.scenes.replay import ReplayScene
from app.scenes.words import Words
from tom import readable
from tom.envs import ENVS
from tom.errors import UserError
from tom.record.store import Store

WORDS_S = 0.2
"""seconds between two updates of the words and the curve while an episode plays"""


class ReplayFrame(Frame):
    """Plays one episode: slider, speed, the ghost beside the robot, the reward so far."""

    title = "Replay"
    shadows = True
    fill = 1.5

    def _build_panel(self) -> None:
        self._replay: Replay | None = None
        self._scene: ReplayScene | None = None
        self._choice: ReplayChoice | None = None
        self._at = 0.0
        self._since = 0.0
        gui = self.client.gui
        self.play = gui.add_button("Play", icon=viser.Icon.PLAYER_PLAY)
        self.playing = False
        self.frame = gui.add_slider("step", 0, 1, 1, 0)
        self.speed = gui.add_dropdown("speed", tuple(SPEEDS), initial_value=REAL_TIME)
        self.follow = gui.add_checkbox("camera follows", initial_value=True)
        self.ghost = gui.add_checkbox("model's ghost", initial_value=True)
        self.words = gui.add_markdown("")
        self.curve = None
        if self.compact:  # in a narrow frame the panel is a sheet that is always open
            for part in (self.speed, self.follow, self.ghost, self.words):
                part.visible = False
        self.play.on_click(lambda _: self._toggle())
        self.frame.on_update(self._scrubbed)
        for box in (self.follow, self.ghost):
            box.on_update(lambda _: self._pose())

    def _show(self, selection: Selection) -> None:
        choice = selection.choice
        assert isinstance(choice, ReplayChoice)
        before, self._choice = self._choice, choice
        run = Store(self.store).run(choice.run)
        replay = replays.load(run, choice.step, choice.episode, choice.horizon)
        if replay is not None and not replay.drawn:
            raise UserError(f"there is nothing to draw of {run.env}: its curves are on the page")
        if replay is None:
            raise UserError(f"episode {choice.episode + 1} of step {choice.step} cannot be read")
        if replay is not self._replay:
            self._draw(replay)
        self.speed.value = choice.speed if choice.speed in SPEEDS else REAL_TIME
        self.ghost.value, self.follow.value = choice.ghost, choice.follow
        if before is None or (before.asked, before.frame) != (choice.asked, choice.frame):
            self._obey(choice)
        self._pose()

    def _obey(self, choice: ReplayChoice) -> None:
        """Carry out the page's wish if its count has increased."""
        if choice.wish == "go":
            self._go_to(choice.frame)
        elif self.playing != (choice.wish == "play"):
            self._toggle()

    def clock(self) -> Clock:
        """The state of playback."""
        with self._lock:  # not between a request and its answer
            asked = 0 if self._choice is None else self._choice.asked
            return Clock(int(self._at), self.playing, asked)

    def _play(self) -> None:
        self._go_to(0)
        self.playing = False
        self._toggle()
        self._pose()

    def _mode_changed(self) -> None:
        self._replay = None

    def _draw(self, replay: Replay) -> None:
        other = self._replay is None or self._replay.env != replay.env
        self._replay = replay
        with self.client.atomic():
            self.clear()
            self._scene = ReplayScene(self.client.scene, replay, self.mode)
        if other:
            self.look(*self._view(self._scene.height))
        self.frame.max = replay.episode.length
        self.ghost.disabled = replay.ghost is None
        self._draw_curve(replay)
        self._go_to(min(self._at, replay.episode.length))

    def _view(self, height: float) -> tuple[Vector, Vector]:
        """The camera's position and target; the robot is left of the panel if that is open."""
        if self._replay is not None and self._replay.road:
            across = 0.5 if self.compact else 0.74
            return (across, -0.4, 1.25), (across, 0.42, 0.0)
        if self._replay is not None and self._replay.env not in ENVS:
            return self._stands_off()
        away = 1.6 + 0.9 * height
        beside = 0.0 if self.compact else 0.25 * away
        return (0.45 * away, -away, 0.5 + 0.6 * height), (beside, 0.0, 0.5 * height)

    def _stands_off(self) -> tuple[Vector, Vector]:
        """A view of an unknown robot, from its extent in the first frame."""
        assert self._scene is not None
        middle, span = self._scene.covered
        away = 0.8 + 1.1 * span
        x, y, z = (float(value) for value in middle)
        beside = 0.0 if self.compact else 0.25 * away
        return (x + 0.45 * away, y - away, z + 0.6 * away), (x + beside, y, z)

    def _words(self) -> Sequence[Words]:
        return () if self._scene is None else self._scene.words

    def _draw_curve(self, replay: Replay) -> None:
        if self.compact:
            return
        if self.curve is not None:
            self.curve.remove()
        line = {"label": "reward", "stroke": "#8a92a3", "width": 1.5}
        now = {"label": "now", "stroke": "#c8441c", "points": {"show": True, "size": 8}}
        axis: dict[str, Any] = {"size": 28, "stroke": "#8a92a3", "grid": {"show": False}}
        self.curve = self.client.gui.add_uplot(
            self._curve_data(replay, 0),
            ({"label": "seconds"}, line, now),  # pyright: ignore[reportArgumentType]
            title="reward in each step, against seconds",
            axes=(axis, {**axis, "size": 36}),  # pyright: ignore[reportArgumentType]
            scales=self._scales(replay),
            legend={"show": False},
            height=150,
        )

    def _scales(self, replay: Replay) -> Any:
        reward = replay.episode.reward
        room = 0.05 * float(np.ptp(reward)) or 1.0
        low, high = float(reward.min()) - room, float(reward.max()) + room
        end = replay.dt * max(len(reward) - 1, 1)
        return {"x": {"time": False, "range": (0.0, end)}, "y": {"range": (low, high)}}

    def _curve_data(self, replay: Replay, frame: int) -> tuple[np.ndarray, ...]:
        reward = replay.episode.reward.astype(np.float64)
        mark = np.full(len(reward), np.nan)
        mark[min(frame, len(reward) - 1)] = reward[min(frame, len(reward) - 1)]
        return replay.dt * np.arange(len(reward)), reward, mark

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
        if not self.playing or self._replay is None:
            return
        self._go_to(self._at + seconds * SPEEDS[self.speed.value] / self._replay.dt)
        self._since += seconds
        self._pose()
        if self._at >= self._replay.episode.length:
            self._toggle()

    def _pose(self) -> None:
        with self._lock:
            if self._scene is None or self._replay is None:
                return
            frame = int(self._at)
            with self.client.atomic():
                self._scene.pose(frame, follow=self.follow.value)
                if self._scene.ghost is not None:
                    self._scene.ghost.visible = self.ghost.value
            if not self.playing or self._since >= WORDS_S:
                self._since = 0.0
                self._describe(frame)

    def _describe(self, frame: int) -> None:
        replay = self._replay
        if replay is None or self.curve is None:
            return
        reward = replay.episode.reward
        now = reward[min(frame, len(reward) - 1)]
        self.words.content = (
            f"{frame * replay.dt:.2f} s of {len(reward) * replay.dt:.2f} s  \n"
            f"reward now **{now:.2f}**  \n"
            f"return so far **{readable.score(float(reward[:frame].sum()))}** of "
            f"{readable.score(float(reward.sum()))}"
        )
        self.curve.data = self._curve_data(replay, frame)
