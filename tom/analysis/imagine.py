"""A run's dynamics model predicts a recorded episode, given the recorded actions."""

from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from tom.config import ModelConfig
from tom.dynamics import make_model
from tom.dynamics.base import Predictor
from tom.envs import ROAD, Task
from tom.errors import UserError, reason
from tom.events import Episode
from tom.record import RunReader, checkpoint
from tom.record.task_record import task_of
from tom.road.agent import RoadModel

Floats = NDArray[np.float32]


@dataclass(frozen=True)
class StoredModel:
    """The last dynamics model of a run, fitted at or before `env_step`."""

    env_step: int
    predictor: Predictor


@dataclass(frozen=True)
class Imagined:
    """A predicted episode of H steps; `obs[0]` is the real first observation."""

    obs: Floats  # (H + 1, O)
    reward: Floats  # (H,)


def stored_model(run: RunReader) -> StoredModel:
    """The model in the newest checkpoint or in a small copy. Raises UserError if there is none."""
    if not run.fits_model:
        raise UserError(f"run '{run.run_id}' has no dynamics model: SAC learns none")
    if run.own_loop:
        raise UserError(f"run '{run.run_id}' has no dynamics model: its loop is not ours")
    try:
        held = checkpoint.load_model(run.path)
    except MemoryError as error:
        raise UserError(f"not enough memory for the model of run '{run.run_id}': {error}") from None
    if held is None:
        small = "model" in run.left_out
        why = "left out of this small copy" if small else "it has no checkpoint that is whole"
        raise UserError(f"run '{run.run_id}' kept no dynamics model: {why}")
    try:
        state = held.state["training"]
        if run.env == ROAD:
            return StoredModel(held.env_step, RoadModel(state["coefficients"]))
        known = task_of(run)
        # Only the model's settings: other groups may differ in another version.
        config = ModelConfig.model_validate(run.config["config"]["model"])
        model = make_model(known.obs_dim, known.action_dim, config, torch.Generator())
        model.load_parameters(state["model"])
        return StoredModel(held.env_step, model)
    except (LookupError, RuntimeError, ValueError, TypeError, AttributeError) as error:
        raise UserError(
            f"the model in the checkpoint of run '{run.run_id}' is another version's: "
            f"{reason(error)}"
        ) from None


@torch.no_grad()
def imagine(model: Predictor, episode: Episode, horizon: int) -> Imagined:
    """Play the recorded actions in the model's mean, restarting from the real state.

    Step t is predicted from the imagined state at t, or from the real state if t is a multiple of
    `horizon`; so every imagined state is 1 to `horizon` steps away from a real one. Once a
    prediction is not finite, the last finite state is repeated. Raises ValueError if `horizon` is
    below 1.
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


def joint_positions(task: Task, episode: Episode, obs: NDArray, dt: float, horizon: int) -> Floats:
    """Joint positions (H + 1, nq) for an episode's imagined observations (H + 1, O).

    Observations leave out the root's position on the ground. It is integrated from the root's
    velocity (trapezoid rule, `dt` seconds), from the real position every `horizon` steps.
    """
    assert episode.qpos is not None, "an episode of a MuJoCo task"
    assert task.root_dims is not None, "whose observations hold the joints"
    qpos = task.qpos_from_obs(np.asarray(obs, np.float32)).copy()
    roots = task.root_dims
    moving = slice(task.nq - roots, task.nq)  # the root's velocity, first of the velocities
    place = np.asarray(episode.qpos[:, :roots], np.float64).copy()
    for t in range(len(obs) - 1):
        restart = t % horizon == 0
        start = episode.qpos[t, :roots] if restart else place[t]
        before = episode.obs[t, moving] if restart else obs[t, moving]
        place[t + 1] = start + 0.5 * dt * (before + obs[t + 1, moving])
    qpos[:, :roots] = place
    return qpos
