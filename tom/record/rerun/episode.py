"""One evaluation episode as a separate Rerun recording, made on request."""

from numpy.typing import NDArray

from tom.events import Episode, Field
from tom.record.reader import RunReader
from tom.record.rerun.blueprint import episode_blueprint
from tom.record.rerun.view import RerunView

FLUSH_S = 10.0


def episode_recording(
    run: RunReader, step: int, episode: Episode, dt: float, ghost: NDArray | None = None
) -> bytes:
    """The bytes of a recording: the robot (or the car on its map), its ghost, its rewards.

    `step` is the evaluation's, `dt` the seconds of a step, `ghost` a model's prediction: joint
    positions (H + 1, nq), or positions (H + 1, 2) on road-and-rocks.
    """
    view = RerunView(
        f"{run.run_id}, step {step}",
        run.env,
        run.learner,
        every=episode.length + 1,
        layout=episode_blueprint(run.env, episode.qpos is not None, episode.obs.shape[1]),
        run=run,
    )
    for at in run.field_steps("map")[:1]:
        view.field(Field(step, "map", run.field("map", at)))
    view.episode(step, episode, dt, ghost)
    recorded = view.read()
    view.close(FLUSH_S)
    return recorded
