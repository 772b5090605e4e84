"""One evaluation episode, and its prediction by the run's model. Independent of any viewer."""

from contextlib import suppress
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from app.data import buffer
from app.data.cache import cached
from app.data.readers import fresh_reader
from app.data.road import RoadShape
from tom.analysis.imagine import Imagined, imagine, joint_positions
from tom.envs import ROAD, scene
from tom.events import Episode
from tom.record.reader import RunReader
from tom.record.task_record import scene_of, seconds, task_of

ROAD_DT = 0.1
"""seconds of a step of road-and-rocks on the screen; the task itself has no clock"""
HORIZONS = (1, 5, 10, 25, 50, 100, 1000)
"""choices of steps after which the ghost restarts from the real state; the last is an episode"""
DEFAULT_HORIZON = 25
CONSTANT_STD = 1e-6
"""standard deviation of a dimension's change per step up to which the change is constant"""

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class Replay:
    """A recorded episode of H steps, and its prediction by the model at `model_step`."""

    run_id: str
    env: str
    learner: str
    step: int
    index: int  # among the episodes of the evaluation at `step`
    model: scene.Model | None  # to draw the robot
    names: tuple[str, ...]  # of the observation's dimensions
    dt: float  # seconds a step
    episode: Episode
    real: Floats  # (H + 1, nq) joint positions; positions (H + 1, 2), or observations
    ghost: Floats | None  # the same, predicted
    imagined: Imagined | None
    model_step: int | None
    no_ghost: str  # why there is no ghost
    road: RoadShape | None  # road-and-rocks only

    @property
    def name(self) -> str:
        """What tells it from every other episode of the store."""
        return f"{self.run_id} {self.step} {self.index}"

    @property
    def has_scene(self) -> bool:
        """Whether there is a robot or a car to draw; else there are only observations."""
        return self.model is not None or self.road is not None

    @property
    def error(self) -> NDArray[np.float64]:
        """Distance (H,) of each predicted state from the real one; needs a ghost.

        Root mean square over dimensions, each in standard deviations of its change in a step.
        Dimensions with constant change have no such scale and are left out; NaN if none remains, as
        in an episode of one step.
        """
        assert self.imagined is not None
        real = self.episode.obs
        scale = np.diff(real, axis=0).std(0)
        scaled = scale > CONSTANT_STD
        if not scaled.any():
            return np.full(self.episode.length, np.nan)
        gap = (self.imagined.obs - real)[1:, scaled] / scale[scaled]
        return np.sqrt(np.square(gap, dtype=np.float64).mean(1))


@cached("episodes", "model")
def load(run: RunReader, step: int, index: int, horizon: int) -> Replay | None:
    """The episode `index` of the evaluation at `step`; None if there is none.

    The ghost restarts from the real state every `horizon` steps. Raises UserError if the run's
    folder does not say what its task is.
    """
    episodes = fresh_reader(run).episodes(step)
    if not 0 <= index < len(episodes) or not episodes[index].length:
        return None
    episode = episodes[index]
    road = None
    if run.env == ROAD and (maps := run.field_steps("map")):
        with suppress(KeyError):
            road = RoadShape.of(fresh_reader(run).field("map", maps[0]))
    robot = None if road or episode.qpos is None else scene_of(run)
    real = episode.obs if robot is None else episode.qpos
    if real is None:
        return None
    task = None if run.env == ROAD else task_of(run)
    dt = ROAD_DT if task is None else seconds(run)
    kept = buffer.stored_model(run)
    imagined = None if isinstance(kept, str) else imagine(kept.predictor, episode, horizon)
    ghost = None if imagined is None or task is not None else imagined.obs
    # The joints, where the observations hold them.
    if imagined and task and task.root_dims is not None and episode.qpos is not None:
        ghost = joint_positions(task, episode, imagined.obs, dt, horizon)
    return Replay(
        run_id=run.run_id,
        env=run.env,
        learner=run.learner,
        step=step,
        index=index,
        model=robot,
        names=("x", "y") if task is None else task.obs_names,
        dt=dt,
        episode=episode,
        real=real,
        ghost=ghost,
        imagined=imagined,
        model_step=None if isinstance(kept, str) else kept.env_step,
        no_ghost=kept if isinstance(kept, str) else "",
        road=road,
    )
