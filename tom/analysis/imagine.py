"""What a run's own dynamics model makes of a recorded episode, given the recorded actions."""

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tom.config import ModelConfig
from tom.dynamics import make_model
from tom.dynamics.linear import LinearModel
from tom.envs import MujocoTask, task
from tom.errors import UserError, reason
from tom.events import Episode
from tom.record import RunReader, checkpoint, layout
from tom.road.model import RoadModel

BATCH = 4096
"""rows that are predicted at once: more do not fit the processor's cache"""

PLACES = (checkpoint.FOLDER, layout.MODEL)
"""folders of a run that may hold its model"""

Floats = NDArray[np.float32]
Stamps = tuple[tuple[int, int, int], ...]
"""step, mtime_ns and size of files"""


class Predictor(Protocol):
    """What is asked of a dynamics model here: its mean."""

    def predict(self, obs: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """The mean (reward (B,), next_obs (B, O)) for obs (B, O) and action (B, A)."""
        ...


@dataclass(frozen=True)
class StoredModel:
    """The dynamics model that a run ended with, fitted last at or before `env_step`."""

    env_step: int
    predictor: Predictor


@dataclass(frozen=True)
class Imagined:
    """What a model makes of an episode of H steps; `obs[0]` is the real one."""

    obs: Floats  # (H + 1, O)
    reward: Floats  # (H,)


def stored_step(run: RunReader) -> int | None:
    """The step of the model that `stored_model` gives, whole or not; None where there is none."""
    found = (checkpoint.newest(run.path / folder) for folder in PLACES)
    return next((step for step in found if step is not None), None)


def stored_stamps(run: RunReader) -> Stamps:
    """What `stored_model` depends on: changes whenever the run keeps another model."""
    try:
        config = (run.path / layout.CONFIG).stat()
    except OSError:  # deleted at this moment
        return ()
    found = [checkpoint.stamps(run.path / folder) for folder in PLACES]
    return ((0, config.st_mtime_ns, config.st_size), *found[0], *found[1])


def stored_model(run: RunReader) -> StoredModel:
    """The model in the newest checkpoint, or in a small copy. Raises UserError without one."""
    if not run.fits_model:
        raise UserError(f"run '{run.run_id}' has no dynamics model: SAC learns none")
    found = (checkpoint.load(run.path / folder) for folder in PLACES)
    held = next((one for one in found if one is not None), None)
    if held is None:
        small = "model" in run.left_out
        why = "left out of this small copy" if small else "it has no checkpoint that is whole"
        raise UserError(f"run '{run.run_id}' kept no dynamics model: {why}")
    try:
        return StoredModel(held.env_step, _predictor(run, held.state["training"]))
    except (LookupError, RuntimeError, ValueError, TypeError, AttributeError) as error:
        raise UserError(
            f"the model in the checkpoint of run '{run.run_id}' is another version's: "
            f"{reason(error)}"
        ) from None


def _predictor(run: RunReader, state: dict[str, Any]) -> Predictor:
    if run.env == "road-and-rocks":
        return RoadModel(LinearModel(state["coefficients"]))
    known = task(run.env)
    # The model's settings alone: another version may have other ones elsewhere.
    config = ModelConfig.model_validate(run.config["config"]["model"])
    model = make_model(known.obs_dim, known.action_dim, config, torch.Generator())
    model.load_parameters(state["model"])
    return model


@torch.no_grad()
def imagine(model: Predictor, episode: Episode, horizon: int) -> Imagined:
    """Play the recorded actions in the model's mean, from the real state every `horizon` steps.

    Step t is predicted from what was imagined at t, or from the real state where t is a multiple
    of `horizon`; so every imagined state is 1 to `horizon` steps away from a real one. From where
    a model's numbers are no longer finite, they stay what they were.
    """
    if horizon < 1:
        raise ValueError(f"horizon must be at least 1, not {horizon}")
    steps = episode.length
    real, action = torch.as_tensor(episode.obs), torch.as_tensor(episode.action)
    obs, reward = real.clone(), torch.zeros(steps)
    starts = torch.arange(0, steps, horizon)
    now = real[starts]
    for ahead in range(min(horizon, steps)):
        at = starts + ahead
        at = at[at < steps]  # only the last stretch may be shorter than the others
        now = now[: len(at)]
        predicted_reward, following = model.predict(now, action[at])
        now = torch.where(following.isfinite(), following, now)
        obs[at + 1], reward[at] = now, predicted_reward.nan_to_num()
    return Imagined(obs.numpy(), reward.numpy())


@torch.no_grad()
def step_errors(model: Predictor, obs: NDArray, action: NDArray, next_obs: NDArray) -> Floats:
    """One-step error (N,) of the predicted next state, root mean square over dimensions.

    Each dimension in standard deviations of its change over these rows, as `model/error_policy`.
    """
    state, control, target = (torch.as_tensor(x).float() for x in (obs, action, next_obs))
    scale = (target - state).std(0, correction=0).clamp(min=1e-6)
    parts = []
    for first in range(0, len(state), BATCH):
        rows = slice(first, first + BATCH)
        _, predicted = model.predict(state[rows], control[rows])
        parts.append(((predicted - target[rows]) / scale).square().mean(1).sqrt())
    return torch.cat(parts).numpy() if parts else np.zeros(0, np.float32)


def joint_positions(
    known: MujocoTask, episode: Episode, obs: NDArray, dt: float, horizon: int
) -> Floats:
    """Joint positions (H + 1, nq) that belong to an episode's imagined observations (H + 1, O).

    An observation leaves out the root's place on the ground: it is integrated from the root's
    velocity (trapezoids of `dt` seconds), from the real place every `horizon` steps.
    """
    assert episode.qpos is not None, "an episode of a MuJoCo task"
    qpos = known.qpos_from_obs(np.asarray(obs, np.float32)).copy()
    roots = known.root_dims
    moving = slice(known.nq - roots, known.nq)  # the root's velocity, first of the velocities
    place = np.asarray(episode.qpos[:, :roots], np.float64).copy()
    for t in range(len(obs) - 1):
        restart = t % horizon == 0
        start = episode.qpos[t, :roots] if restart else place[t]
        before = episode.obs[t, moving] if restart else obs[t, moving]
        place[t + 1] = start + 0.5 * dt * (before + obs[t + 1, moving])
    qpos[:, :roots] = place
    return qpos
