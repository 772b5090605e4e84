"""What a model of stable-baselines3 learnt from, and its policy, in files that `tom weigh` reads.

The library keeps both in pickles, which are code. Here they become numbers and a network:

    from tom.integrations import sb3

    sb3.export_buffer(model, "buffer.npz")
    sb3.export_policy(model, "policy.pt")

`sb3.RecordCallback` records a training while it runs (tom/integrations/sb3_callback.py).
"""

import warnings
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tom.errors import UserError

Columns = dict[str, NDArray]


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
