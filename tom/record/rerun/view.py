"""The data of a run in Rerun, their paths, and the layouts that show everything without a click.

Timelines: `env_step` for everything (the frames of an evaluation follow its step), and `replay`,
on which the evaluation episodes follow each other in real time.
"""

from collections.abc import Mapping
from functools import cached_property

import numpy as np
import pandas as pd
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from tom.config import EvaluationConfig
from tom.envs import ROAD, scene
from tom.events import Episode
from tom.learners import LEARNERS, learner_colour
from tom.record.reader import RunReader
from tom.record.rerun import drawing
from tom.record.rerun.drawing import MAP
from tom.record.task_record import scene_of, seconds

PROFILE = "weights/profile"
SCENE = "scene"
TRACKED = f"{SCENE}/place"  # moves along with the robot; the camera sits on it
ROBOT = f"{SCENE}/robot"
GHOST = f"{SCENE}/ghost"  # the robot as a model predicts it
CAR, GHOST_CAR = f"{MAP}/car", f"{MAP}/ghost"
REWARD = "reward"
OBSERVED = "observation"

CURVES = {
    "Return": ("eval/return", "eval/return_max"),
    "Dynamics model: loss": ("model/train_nll", "model/holdout_nll", "model/holdout_nll_uniform"),
    "Weights": ("weights/ess", "weights/zeros", "weights/age_correlation"),
    "Policy: losses": ("critic/loss", "actor/loss"),
}

EPISODE_FLUSH_S = 10.0

FRAMES_PER_S = 30
PAUSE_S = 0.5  # between two episodes on the timeline `replay`


class RerunView:
    """One run's recording. Every method may block while its sink does."""

    def __init__(
        self,
        run: RunReader,
        sink: rr.FileSink | None = None,
        *,
        name: str = "",
        every: int | None = None,
        layout: rrb.Blueprint | None = None,
    ) -> None:
        """Without a sink, `read` returns the bytes.

        `name` replaces the run's id, `every` its env steps between two evaluations, and `layout`
        the layout of a whole run.
        """
        self._run = run
        self._env = run.env
        evaluation = run.given.get("evaluation") or {}
        self._every = every or evaluation.get("every") or EvaluationConfig().every
        """env steps between two evaluations"""
        self._replay_s = 0.0
        self._floor_drawn = False
        # Viewers store one layout per application id, so runs with other layouts get another id.
        application = f"tom-studio {run.env} {run.learner}{' episode' if layout else ''}"
        layout = layout or blueprint(run.env, run.learner, drawn=self._model is not None)
        # Chunks of seconds instead of a fifth of one, because many small ones slow a viewer.
        batches = rr.ChunkBatcherConfig(flush_tick=1.0)
        name = name or run.run_id
        self.stream = rr.RecordingStream(application, recording_id=name, batcher_config=batches)
        self.stream.set_log_tick_enabled(False)
        self.stream.set_log_time_enabled(False)
        self._bytes: rr.BinaryStream | None = None
        if sink is None:
            self._bytes = self.stream.binary_stream()
            self.stream.send_blueprint(layout)
        else:
            self.stream.set_sinks(sink, default_blueprint=layout)
        self.stream.send_recording_name(name)
        # Otherwise the viewer chooses a colour, which may be another learner's.
        self._colour = [*bytes.fromhex(learner_colour(run.learner).removeprefix("#"))]

    def read(self) -> bytes:
        """The bytes recorded since the last call, if there is no sink."""
        return (self._bytes.read() if self._bytes else None) or b""

    def metrics(self, table: pd.DataFrame) -> None:
        """The rows of a table of metrics, each finite value as a scalar at the metric's path.

        They are sent together: singly each would cost a kilobyte and slow the viewer.
        """
        for path in table.columns.drop("env_step"):
            known = table[["env_step", path]].dropna()
            if len(known):
                times = rr.TimeColumn("env_step", sequence=np.asarray(known["env_step"]))
                columns = rr.Scalars.columns(scalars=np.asarray(known[path]))
                self.stream.send_columns(path, [times], columns)

    def profile(self, env_step: int, bins: NDArray[np.float64]) -> None:
        """The weight profile as bars; an empty bin has height 0."""
        self.stream.set_time("env_step", sequence=env_step)
        self.stream.log(PROFILE, rr.BarChart(np.nan_to_num(bins), color=self._colour))

    def evaluation(self, env_step: int) -> None:
        """Draw the first episode: its robot, or its observations if there is no robot."""
        for episode in self._run.episodes(env_step)[:1]:
            if episode.qpos is not None and self._model is not None:
                self._replay(env_step, episode.length, {ROBOT: episode.qpos})
            elif self._env != ROAD:
                dt = seconds(self._run)
                self._observe(env_step, episode, dt)
                self._replay_s += episode.length * dt + PAUSE_S

    def episode(self, env_step: int, episode: Episode, dt: float, ghost: NDArray | None) -> None:
        """Draw one episode with the reward of every step, at `dt` seconds per step.

        `ghost`: joint positions (H + 1, nq) of a translucent robot beside the real one;
        on road-and-rocks positions (H + 1, 2). Without a robot, curves of observations are drawn.
        """
        steps = np.arange(episode.length)
        times = self._times(env_step, episode.length, steps, dt)
        self.stream.send_columns(REWARD, times, rr.Scalars.columns(scalars=episode.reward))
        if self._env != ROAD and (episode.qpos is None or self._model is None):
            self._observe(env_step, episode, dt)
            return
        if episode.qpos is not None:
            both = {ROBOT: episode.qpos} | ({} if ghost is None else {GHOST: ghost})
            self._replay(env_step, episode.length, both)
            return
        steps = np.arange(episode.length + 1)
        times = self._times(env_step, episode.length, steps, dt)
        drawing.car(self.stream, CAR, times, episode.obs, drawing.LEARNT)
        if ghost is not None:
            drawing.car(self.stream, GHOST_CAR, times, ghost, drawing.MODELLED)

    def close(self, timeout_s: float) -> None:
        """Flush the remaining data. Raises an error if the sink takes too long."""
        self.stream.flush(timeout_sec=timeout_s)
        self.stream.disconnect()

    def _replay(self, env_step: int, length: int, robots: Mapping[str, NDArray]) -> None:
        """Draw robots by path, moving through joint positions (length + 1, nq)."""
        model = self._model
        assert model is not None
        stride = max(1, int(1 / (FRAMES_PER_S * model.dt)))
        frames = np.arange(0, length + 1, stride)
        times = self._times(env_step, length, frames, model.dt)
        self._replay_s += float(frames[-1]) * model.dt + PAUSE_S
        for path, qpos in robots.items():
            drawn = scene.geometry(model.mj, qpos[frames])
            if drawn.floor is not None and not self._floor_drawn:
                drawing.floor(self.stream, drawn.floor)
                self._floor_drawn = True
            drawing.robot(self.stream, path, times, drawn, ghost=path == GHOST)
            if path == ROBOT:
                place = drawn.root * np.array([1, 1, 0], np.float32)
                moves = rr.Transform3D.columns(translation=place)
                self.stream.send_columns(TRACKED, times, moves)

    @cached_property
    def _model(self) -> scene.Model | None:
        return scene_of(self._run)

    def _observe(self, env_step: int, episode: Episode, dt: float) -> None:
        """Draw every dimension of an episode's observations as a curve."""
        frames = np.arange(episode.length + 1)
        times = self._times(env_step, episode.length, frames, dt)
        for i, values in enumerate(np.asarray(episode.obs, np.float64).T):
            columns = rr.Scalars.columns(scalars=values)
            self.stream.send_columns(f"{OBSERVED}/{i + 1}", times, columns)

    def _times(self, env_step: int, length: int, frames: NDArray, dt: float) -> drawing.Times:
        """Times of the frames; on `env_step` they end at the evaluation's step."""
        span = min(length, max(self._every - 1, 0), env_step)
        steps = env_step - span + frames * span // max(length, 1)
        return (
            rr.TimeColumn("env_step", sequence=steps),
            rr.TimeColumn("replay", duration=self._replay_s + frames * dt),
        )


def episode_recording(
    run: RunReader, step: int, episode: Episode, dt: float, ghost: NDArray | None = None
) -> bytes:
    """One evaluation episode as a recording: the robot (or the car on its map), ghost, rewards.

    `step` is the evaluation's, `dt` the seconds of a step, `ghost` a model's prediction: joint
    positions (H + 1, nq), or positions (H + 1, 2) on road-and-rocks.
    """
    view = RerunView(
        run,
        name=f"{run.run_id}, step {step}",
        every=episode.length + 1,
        layout=episode_blueprint(run.env, episode.qpos is not None, episode.obs.shape[1]),
    )
    if run.env == ROAD and (at := run.field_steps("map")):
        drawing.road_map(view.stream, run.field("map", at[0]))
    view.episode(step, episode, dt, ghost)
    recorded = view.read()
    view.close(EPISODE_FLUSH_S)
    return recorded


def blueprint(env: str, learner: str, *, drawn: bool = True) -> rrb.Blueprint:
    """Robot and weight profile on the left, curves on the right.

    If nothing can be `drawn`, curves of the observations replace the robot; road-and-rocks, whose
    map the studio draws, has neither.
    """
    picture = _robot("First evaluation episode")
    if not drawn:
        picture = _plot("Observations of the first evaluation episode", (f"{OBSERVED}/**",))
    profile = rrb.BarChartView(origin=PROFILE, name="Mean weight, oldest to newest transitions")
    own = LEARNERS[learner].charts if learner in LEARNERS else {}
    plots = [_plot(name, paths) for name, paths in {**CURVES, **own}.items()]
    left = profile if env == ROAD else rrb.Vertical(picture, profile, row_shares=[3, 2])
    return _without_panels(
        rrb.Horizontal(left, rrb.Vertical(*plots), column_shares=[3, 2]),
        rrb.TimePanel(state="collapsed", timeline="env_step", fps=100.0, play_state="following"),
    )


def episode_blueprint(env: str, drawn: bool = True, observed: int = 0) -> rrb.Blueprint:
    """One episode in real time, in a loop: the robot or the car, and the reward.

    If nothing can be `drawn`, curves of `observed` dimensions replace the robot.
    """
    name = "The episode; red: what the model imagines"
    picture = _map(name) if env == ROAD else _robot(name)
    if env != ROAD and not drawn:
        picture = _plot("Observations", tuple(f"{OBSERVED}/{i + 1}" for i in range(observed)))
    return _without_panels(
        rrb.Vertical(picture, _plot("Reward of each step", (REWARD,)), row_shares=[3, 1]),
        rrb.TimePanel(state="collapsed", timeline="replay", play_state="playing", loop_mode="all"),
    )


def _without_panels(views: rrb.Container, time: rrb.TimePanel) -> rrb.Blueprint:
    return rrb.Blueprint(
        views,
        time,
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        rrb.TopPanel(state="collapsed"),
    )


def _robot(name: str) -> rrb.Spatial3DView:
    return rrb.Spatial3DView(
        origin=TRACKED,
        contents=f"/{SCENE}/**",
        name=name,
        line_grid=False,
        eye_controls=rrb.EyeControls3D(position=(0.4, -2.6, 1.1), look_target=(0.0, 0.0, 0.65)),
    )


def _map(name: str) -> rrb.Spatial2DView:
    return rrb.Spatial2DView(
        origin=f"/{MAP}",
        name=name,
        visual_bounds=rrb.VisualBounds2D(x_range=[-0.05, 1.05], y_range=[-1.05, 0.05]),
    )


def _plot(name: str, paths: tuple[str, ...]) -> rrb.TimeSeriesView:
    everything = rr.TimeRange(
        start=rr.TimeRangeBoundary.infinite(), end=rr.TimeRangeBoundary.infinite()
    )
    # A corner that lines rarely cross: returns rise, losses fall.
    corner = rrb.Corner2D.RightBottom if name == "Return" else rrb.Corner2D.RightTop
    # Points are always shown, because a metric with a single value has no line.
    return rrb.TimeSeriesView(
        origin="/",
        contents=[f"+ /{path}" for path in paths],
        name=name,
        axis_x=rrb.TimeAxis(view_range=everything),
        plot_legend=rrb.PlotLegend(corner),
        interaction=rrb.PlotInteraction(points_display="Always"),
    )
