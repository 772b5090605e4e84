"""What a model of stable-baselines3 learnt from, and its policy, in files that `tom weigh` reads.

The library keeps both in pickles, which are code. Here they become numbers and a network:

    from tom.integrations import sb3

    sb3.export_buffer(model, "buffer.npz")
    sb3.export_policy(model, "policy.pt")

`sb3.RecordCallback` (tom/integrations/sb3_callback.py) records a training while it runs, by the
last functions here.
"""

import warnings
from collections.abc import Mapping
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tom.errors import UserError

Columns = dict[str, NDArray]
OURS = {
    "eval/mean_reward": "eval/return",
    "train/critic_loss": "critic/loss",
    "train/actor_loss": "actor/loss",
    "train/ent_coef": "temperature/value",
}
"""the library's names of what has a name here"""
SETTINGS = ("learning_rate", "batch_size", "gamma", "tau", "buffer_size", "learning_starts")


def __getattr__(name: str) -> Any:
    if name != "RecordCallback":
        raise AttributeError(f"module {__name__} has no {name}")
    return import_module("tom.integrations.sb3_callback").RecordCallback


def export_buffer(model: Any, path: str | Path) -> None:
    """Write the replay buffer of an off-policy `model` (SAC, TD3, DDPG) as `.npz`.

    One environment's rows after the other's, each oldest first, actions in the task's own units.
    With `handle_timeout_termination=False` an episode of exactly the task's limit counts as
    truncated, and the oldest, unfinished one of a full buffer is left out, since its length is not
    known. With `optimize_memory_usage=True` so is the last row of each episode: the buffer has
    overwritten its successor. Rows left out are said by a warning. Raises UserError for other
    buffers.
    """
    buffer = getattr(model, "replay_buffer", None)
    if buffer is None or not isinstance(getattr(buffer, "observations", None), np.ndarray):
        raise UserError("the model has no replay buffer of flat observations: SAC, TD3 or DDPG")
    if buffer.actions.dtype.kind != "f" or buffer.observations.ndim != 3:
        raise UserError("only flat observations and continuous actions can be weighed")
    kept = [_rows_of(model, buffer, env) for env in range(buffer.n_envs)]
    count = sum(len(columns["reward"]) for columns in kept)
    held = buffer.size() * buffer.n_envs
    if not count:
        raise UserError("the replay buffer holds no row that can be used: train for longer")
    if count < held:
        warnings.warn(f"{held - count} of {held} rows are left out of {path}", stacklevel=2)
    columns = {name: np.concatenate([of[name] for of in kept]) for name in kept[0]}
    np.savez(path, allow_pickle=False, **columns)


def _rows_of(model: Any, buffer: Any, env: int) -> Columns:
    """The rows of one environment, oldest first; the last one ends its episode."""
    size = buffer.size()
    order = (np.arange(size) + (buffer.pos if buffer.full else 0)) % buffer.buffer_size
    saving = buffer.optimize_memory_usage
    if saving and buffer.full:
        order = order[1:]  # the oldest row's obs is the newest row's successor by now
    done = buffer.dones[order, env] == 1
    cut = done & (buffer.timeouts[order, env] == 1)
    usable = np.ones(len(order), bool)
    if not buffer.handle_timeout_termination:
        last = np.flatnonzero(done)
        length = np.diff(last, prepend=-1)
        cut[last[length == _limit(model)]] = True
        if buffer.full:
            usable[: last[0] + 1 if len(last) else 0] = False
    if saving:
        usable &= ~done
        after = buffer.observations[(order + 1) % buffer.buffer_size, env]
        cut = cut | np.append(done[1:], False)  # the row before one that is left out
    else:
        after = buffer.next_observations[order, env]
    if usable.any():
        newest = np.flatnonzero(usable)[-1]
        cut[newest] |= not done[newest]
    columns = {
        "obs": buffer.observations[order, env],
        "action": model.policy.unscale_action(buffer.actions[order, env]),
        "reward": buffer.rewards[order, env],
        "next_obs": after,
        "terminated": done & ~cut,
        "truncated": cut,
    }
    return {name: values[usable] for name, values in columns.items()}


def _limit(model: Any) -> int | None:
    """The time limit of the model's task; None if it has none, or is not there any more."""
    if model.get_env() is None:
        return None
    spec = model.get_env().get_attr("spec")[0]
    return None if spec is None else spec.max_episode_steps


class _Gaussian(torch.nn.Module):
    """SAC's actor: observations to mean and log standard deviation, before the tanh."""

    def __init__(self, actor: Any) -> None:
        super().__init__()
        self.actor = actor

    def forward(self, obs: Tensor) -> tuple[Tensor, Tensor]:
        mean, log_std, _ = self.actor.get_action_dist_params(obs)
        return mean, log_std


class _Deterministic(torch.nn.Module):
    """TD3's and DDPG's actor: observations to actions in the task's own units."""

    def __init__(self, actor: Any, low: NDArray, high: NDArray) -> None:
        super().__init__()
        self.actor = actor
        self.low, self.high = torch.as_tensor(low), torch.as_tensor(high)

    def forward(self, obs: Tensor) -> Tensor:
        return self.low + 0.5 * (self.actor(obs) + 1) * (self.high - self.low)


def export_policy(model: Any, path: str | Path) -> None:
    """Write the policy of SAC, TD3 or DDPG as TorchScript."""
    actor = model.actor.cpu().eval()
    gaussian = hasattr(actor, "get_action_dist_params")
    bounds = model.action_space.low, model.action_space.high
    network = _Gaussian(actor) if gaussian else _Deterministic(actor, *bounds)
    example = torch.zeros(1, *model.observation_space.shape)
    torch.jit.trace_module(network, {"forward": example}).save(str(path))


def settings(model: Any) -> dict[str, Any]:
    """What `tom.record` is told of a model in training, which goes on if it has learnt before.

    The task only if it has a Gymnasium id.
    """
    env, kept = model.get_env(), {name: getattr(model, name, None) for name in SETTINGS}
    numbers = {name: value for name, value in kept.items() if isinstance(value, int | float)}
    spec, at = env.get_attr("spec")[0], model.num_timesteps
    return {
        **({"env": spec.id} if spec else {}),
        **({"resume": "auto", "step": at} if at else {}),
        "envs": env.num_envs,
        "seed": model.seed or 0,
        "steps": model._total_timesteps,
        "config": {"algorithm": type(model).__name__, **numbers},
    }


def newest_obs(model: Any, obs: Any) -> NDArray:
    """The observations (E, O) that a model in training has got, in the task's own units."""
    normalised = model.get_vec_normalize_env()
    return obs.copy() if normalised is None else normalised.get_original_obs()


def newest_steps(
    model: Any, step: Mapping[str, Any]
) -> tuple[NDArray, NDArray, NDArray, NDArray, NDArray]:
    """Action (E, A), reward, next_obs (E, O), terminated, truncated (E,) in the task's own units.

    `step` are the locals of a callback.
    """
    normalised, ended, infos = model.get_vec_normalize_env(), step["dones"], step["infos"]
    reward = step["rewards"] if normalised is None else normalised.get_original_reward()
    next_obs = newest_obs(model, step["new_obs"])
    for env in np.flatnonzero(ended):
        last = infos[env]["terminal_observation"]
        next_obs[env] = last if normalised is None else normalised.unnormalize_obs(last)
    cut = ended & np.array([info.get("TimeLimit.truncated", False) for info in infos])
    return step.get("clipped_actions", step["actions"]), reward, next_obs, ended & ~cut, cut


def logged(values: Mapping[str, Any]) -> dict[str, float]:
    """The numbers that the library logs, but its times, under the names that they have here."""
    numbers = {k: v for k, v in values.items() if isinstance(v, float | int | np.number)}
    return {OURS.get(k, k): float(v) for k, v in numbers.items() if not k.startswith("time/")}
