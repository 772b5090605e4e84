"""One evaluation episode, and what the run's own model makes of it. Knows no viewer."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from app.data.pictures import ENV as ROAD
from app.data.readers import Stamp, stamp
from app.data.roadmap import RoadMap
from tom.analysis.imagine import (
    Imagined,
    Stamps,
    StoredModel,
    imagine,
    joint_positions,
    stored_model,
    stored_stamps,
)
from tom.envs import scene, task
from tom.errors import UserError
from tom.events import Episode
from tom.record import layout
from tom.record.reader import RunReader
from tom.record.rerun.episode import episode_recording

ROAD_DT = 0.1
"""seconds that a step of road-and-rocks takes on the screen: the task itself has no clock"""
HORIZONS = (1, 5, 10, 25, 50, 100, 1000)
"""steps after which the ghost may start again from the real state; the last is a whole episode"""
ALIKE = 1e-6
"""standard deviation of a dimension's change in a step up to which it always changes alike"""

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class Replay:
    """An episode of H steps as it was, and as the model at `model_step` imagines it."""

    env: str
    learner: str
    step: int
    dt: float  # seconds a step
    episode: Episode
    real: Floats  # (H + 1, nq) joint positions; road-and-rocks: positions (H + 1, 2)
    ghost: Floats | None  # the same, imagined
    imagined: Imagined | None
    model_step: int | None
    no_ghost: str  # why there is none
    road: RoadMap | None  # road-and-rocks only

    @property
    def error(self) -> NDArray[np.float64]:
        """Distance (H,) of each imagined state from the real one; needs a ghost.

        Root mean square over dimensions, each in standard deviations of its change in a step. One
        that always changes alike has no such scale and is left out; NaN where no other is there,
        as in an episode of one step.
        """
        assert self.imagined is not None
        real = self.episode.obs
        scale = np.diff(real, axis=0).std(0)
        scaled = scale > ALIKE
        if not scaled.any():
            return np.full(self.episode.length, np.nan)
        gap = (self.imagined.obs - real)[1:, scaled] / scale[scaled]
        return np.sqrt(np.square(gap, dtype=np.float64).mean(1))


def load(run: RunReader, step: int, index: int, horizon: int) -> Replay | None:
    """The episode `index` of the evaluation at `step`; None where it is not there.

    The ghost starts again from the real state every `horizon` steps. What comes back is kept, until
    the episode or the run's model is another one, and shared: nobody may change it.
    """
    episode = stamp(run.path / layout.episodes(step))
    return _load(str(run.path), step, index, horizon, episode, stored_stamps(run))


def recording(run: RunReader, step: int, index: int, horizon: int) -> bytes | None:
    """The episode and its ghost as a Rerun recording; None where it is not there."""
    replay = load(run, step, index, horizon)
    if replay is None:
        return None
    return episode_recording(run, step, replay.episode, replay.dt, replay.ghost)


@lru_cache(maxsize=32)
def _load(
    path: str, step: int, index: int, horizon: int, changed: Stamp, model: Stamps
) -> Replay | None:
    run = RunReader(path)
    episodes = run.episodes(step)
    if not 0 <= index < len(episodes) or not episodes[index].length:
        return None
    episode = episodes[index]
    road = _road(run) if run.env == ROAD else None
    real = episode.obs if road else episode.qpos
    if real is None:
        return None
    dt = ROAD_DT if road else scene.model(run.env).dt
    kept, why = _kept(run, model)
    imagined = None if kept is None else imagine(kept.predictor, episode, horizon)
    return Replay(
        env=run.env,
        learner=run.learner,
        step=step,
        dt=dt,
        episode=episode,
        real=real,
        ghost=None if imagined is None else _ghost(run.env, episode, imagined, dt, horizon),
        imagined=imagined,
        model_step=None if kept is None else kept.env_step,
        no_ghost=why,
        road=road,
    )


def _ghost(env: str, episode: Episode, imagined: Imagined, dt: float, horizon: int) -> Floats:
    if env == ROAD:
        return imagined.obs
    return joint_positions(task(env), episode, imagined.obs, dt, horizon)


def _road(run: RunReader) -> RoadMap | None:
    recorded = run.field_steps("map")
    try:
        return RoadMap.of(run.field("map", recorded[0])) if recorded else None
    except KeyError:
        return None


def _kept(run: RunReader, model: Stamps) -> tuple[StoredModel | None, str]:
    try:
        return _kept_at(str(run.path), model), ""
    except UserError as error:
        return None, str(error)


@lru_cache(maxsize=16)
def _kept_at(path: str, model: Stamps) -> StoredModel:
    return stored_model(RunReader(path))
