"""What of a run goes into Rerun, and under which path; how it is laid out is in blueprint.py.

Timelines: `env_step`, on which everything lives (the frames of an evaluation follow its step),
and `replay`, on which the evaluation episodes follow each other in real time.
"""

from collections.abc import Mapping

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from tom.envs import ENVS, scene
from tom.events import Episode, Evaluation, Field
from tom.learners import LEARNERS
from tom.metrics import describe
from tom.record.rerun import road as rerun_road
from tom.record.rerun import robot as rerun_robot
from tom.record.rerun.blueprint import (
    CAR,
    FIT,
    GHOST,
    GHOST_CAR,
    PROFILE,
    REWARD,
    ROBOT,
    TRACKED,
    blueprint,
)

ROWS = 256  # of metrics that are sent together: a viewer takes a second for some hundred chunks

NEUTRAL = "8a92a3"  # weights of a learner that has no colour
FRAMES_PER_S = 30
PAUSE_S = 0.5  # between two episodes on the timeline `replay`


class RerunView:
    """One run's recording. Every method may block as long as its sink does."""

    def __init__(
        self,
        run_id: str,
        env: str,
        learner: str,
        every: int,
        sink: rr.FileSink | None = None,
        layout: rrb.Blueprint | None = None,
    ) -> None:
        """`every` env steps lie between two evaluations; without a sink, `read` the bytes.

        `layout`: instead of the one of a whole run.
        """
        self._env = env
        self._every = every
        self._replay_s = 0.0
        self._floor_drawn = False
        self._places = 0
        self._scalars: dict[str, list[tuple[int, float]]] = {}
        self._rows = 0
        # Viewers keep one layout for an application: runs that differ in theirs differ in it.
        application = f"tom-studio {env} {learner}{' episode' if layout else ''}"
        layout = layout or blueprint(env, learner)
        # Chunks of seconds, not of a fifth of one: a viewer is slow with many small ones.
        batches = rr.ChunkBatcherConfig(flush_tick=1.0)
        self._stream = rr.RecordingStream(application, recording_id=run_id, batcher_config=batches)
        self._stream.set_log_tick_enabled(False)
        self._stream.set_log_time_enabled(False)
        self._bytes: rr.BinaryStream | None = None
        if sink is None:
            self._bytes = self._stream.binary_stream()
            self._stream.send_blueprint(layout)
        else:
            self._stream.set_sinks(sink, default_blueprint=layout)
        self._stream.send_recording_name(run_id)
        # Without one the viewer takes a colour of its own, and that is another learner's.
        entry = LEARNERS.get(learner)
        colour = entry.colour if entry else None
        self._colour = [*bytes.fromhex(colour.removeprefix("#") if colour else NEUTRAL)]

    def read(self) -> bytes:
        """What was recorded since the last call, where there is no sink."""
        return (self._bytes.read() if self._bytes else None) or b""

    def metrics(self, env_step: int, values: Mapping[str, float]) -> None:
        """Each finite value as a scalar at the metric's path; sent with the next `flush`."""
        for path, value in values.items():
            if np.isfinite(value):
                self._scalars.setdefault(path, []).append((env_step, value))
        self._rows += 1
        if self._rows >= ROWS:
            self.flush()
        if self._env not in ENVS and any(path.startswith("model/") for path in values):
            self._stream.set_time("env_step", sequence=env_step)
            self._stream.log(FIT, rr.TextDocument(_table(values), media_type=rr.MediaType.MARKDOWN))

    def flush(self) -> None:
        """Send the metrics that wait: a value alone would cost a kilobyte and slow the viewer."""
        for path, points in self._scalars.items():
            steps, values = zip(*points, strict=True)
            times = rr.TimeColumn("env_step", sequence=np.array(steps))
            columns = rr.Scalars.columns(scalars=np.array(values))
            self._stream.send_columns(path, [times], columns)
        self._scalars, self._rows = {}, 0

    def profile(self, env_step: int, bins: NDArray[np.float64]) -> None:
        """The weight profile as bars; an empty bin has height 0."""
        self._stream.set_time("env_step", sequence=env_step)
        self._stream.log(PROFILE, rr.BarChart(np.nan_to_num(bins), color=self._colour))

    def places(self, places: NDArray) -> None:
        """Where the transitions lie on the map, (N, 2); drawn once."""
        self._places = len(places)
        rerun_road.places(self._stream, places)

    def weights(self, env_step: int, weight: NDArray) -> None:
        """Each transition on the map in the colour of its weight, (N,)."""
        if self._places != len(weight):
            return
        self._stream.set_time("env_step", sequence=env_step)
        rerun_road.weights(self._stream, weight)

    def evaluation(self, evaluation: Evaluation) -> None:
        """The first episode, where it has MuJoCo states."""
        for episode in evaluation.episodes[:1]:
            if episode.qpos is not None:
                self._replay(evaluation.env_step, episode.length, {ROBOT: episode.qpos})

    def episode(self, env_step: int, episode: Episode, dt: float, ghost: NDArray | None) -> None:
        """One episode with the reward of every step, in its own time of `dt` seconds a step.

        `ghost`: joint positions (H + 1, nq) of a translucent robot beside the real one;
        road-and-rocks: places (H + 1, 2).
        """
        steps = np.arange(episode.length)
        times = self._times(env_step, episode.length, steps, dt)
        self._stream.send_columns(REWARD, times, rr.Scalars.columns(scalars=episode.reward))
        if episode.qpos is not None:
            both = {ROBOT: episode.qpos} | ({} if ghost is None else {GHOST: ghost})
            self._replay(env_step, episode.length, both)
            return
        steps = np.arange(episode.length + 1)
        times = self._times(env_step, episode.length, steps, dt)
        rerun_road.car(self._stream, CAR, times, episode.obs, rerun_road.LEARNT)
        if ghost is not None:
            rerun_road.car(self._stream, GHOST_CAR, times, ghost, rerun_road.MODELLED)

    def field(self, field: Field) -> None:
        """Road-and-rocks: the map, the trajectories and the model's displacements."""
        if self._env in ENVS:
            return
        self._stream.set_time("env_step", sequence=field.env_step)
        rerun_road.picture(self._stream, field.name, field.arrays)

    def close(self, timeout_s: float) -> None:
        """Write out what is left; raises when the sink does not take it in time."""
        self.flush()
        self._stream.flush(timeout_sec=timeout_s)
        self._stream.disconnect()

    def _replay(self, env_step: int, length: int, robots: Mapping[str, NDArray]) -> None:
        """Robots by path, moving through joint positions (length + 1, nq); the eye follows one."""
        model = scene.model(self._env)
        stride = max(1, int(1 / (FRAMES_PER_S * model.dt)))
        frames = np.arange(0, length + 1, stride)
        times = self._times(env_step, length, frames, model.dt)
        self._replay_s += float(frames[-1]) * model.dt + PAUSE_S
        for path, qpos in robots.items():
            drawn = scene.geometry(model.mj, qpos[frames])
            if drawn.floor is not None and not self._floor_drawn:
                rerun_robot.floor(self._stream, drawn.floor)
                self._floor_drawn = True
            rerun_robot.draw(self._stream, path, times, drawn, ghost=path == GHOST)
            if path == ROBOT:
                place = drawn.root * np.array([1, 1, 0], np.float32)
                moves = rr.Transform3D.columns(translation=place)
                self._stream.send_columns(TRACKED, times, moves)

    def _times(self, env_step: int, length: int, frames: NDArray, dt: float) -> rerun_robot.Times:
        steps = env_step + frames * self._every // max(length + 1, self._every)
        return (
            rr.TimeColumn("env_step", sequence=steps),
            rr.TimeColumn("replay", duration=self._replay_s + frames * dt),
        )


def _table(values: Mapping[str, float]) -> str:
    """What a fit measured, as a table."""
    groups = ("weights/", "model/", "planner/", "discriminator/", "dual/")
    rows = [(path, value) for path, value in values.items() if path.startswith(groups)]
    lines = [f"| {path} | {value:.4g} | {describe(path)} |" for path, value in sorted(rows)]
    return "\n".join(["| metric | value | meaning |", "|---|---|---|", *lines])
