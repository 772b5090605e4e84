"""What a model of stable-baselines3 learnt from, and its policy, in files that `tom weigh` reads.

The library keeps both in pickles, which are code. Here they become numbers and a network:

    from tom.integrations import sb3

    sb3.export_buffer(model, "buffer.npz")
    sb3.export_policy(model, "policy.pt")

`sb3.RecordCallback` records a training while it runs (docs/your-own-loop.md).
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import KVWriter
from torch import Tensor

from tom.errors import UserError
from tom.own_loop.live import weigh_live
from tom.own_loop.run import record

Columns = dict[str, NDArray]
METRIC_NAMES = {
    "eval/mean_reward": "eval/return",
    "train/critic_loss": "critic/loss",
    "train/actor_loss": "actor/loss",
    "train/ent_coef": "temperature/value",
}
"""the library's names of what has a name here"""
SETTINGS = ("learning_rate", "batch_size", "gamma", "tau", "buffer_size", "learning_starts")


def export_buffer(model: Any, path: str | Path) -> None:
    """Write the replay buffer of an off-policy `model` (SAC, TD3, DDPG) as `.npz`.

    One environment's rows after the other's, each oldest first, actions in the task's own units.
    Raises UserError for other buffers, and for one that does not keep the end of each episode.
    """
    buffer = getattr(model, "replay_buffer", None)
    if buffer is None or not isinstance(getattr(buffer, "observations", None), np.ndarray):
        raise UserError("the model has no replay buffer of flat observations: SAC, TD3 or DDPG")
    if buffer.actions.dtype.kind != "f" or buffer.observations.ndim != 3:
        raise UserError("only flat observations and continuous actions can be weighed")
    if buffer.optimize_memory_usage or not buffer.handle_timeout_termination:
        raise UserError(
            "the buffer does not tell cut episodes from ended ones: leave optimize_memory_usage "
            "and handle_timeout_termination at their defaults"
        )
    kept = [_rows_of(model, buffer, env) for env in range(buffer.n_envs)]
    columns = {name: np.concatenate([of[name] for of in kept]) for name in kept[0]}
    np.savez(path, allow_pickle=False, **columns)


def _rows_of(model: Any, buffer: Any, env: int) -> Columns:
    """The rows of one environment, oldest first; the last one ends its episode."""
    start = buffer.pos if buffer.full else 0
    order = (np.arange(buffer.size()) + start) % buffer.buffer_size
    done = buffer.dones[order, env] == 1
    cut = done & (buffer.timeouts[order, env] == 1)
    cut[-1] |= not done[-1]
    return {
        "obs": buffer.observations[order, env],
        "action": model.policy.unscale_action(buffer.actions[order, env]),
        "reward": buffer.rewards[order, env],
        "next_obs": buffer.next_observations[order, env],
        "terminated": done & ~cut,
        "truncated": cut,
        "policy_version": np.arange(1, len(order) + 1),  # steps, as in the other environments
    }


class _Network(torch.nn.Module):
    """An actor: SAC's mean and log standard deviation before the tanh; else actions, own units.

    Its observations have the task's own units, also if the model saw `normalised` ones.
    """

    def __init__(self, actor: Any, space: Any, normalised: Any) -> None:
        super().__init__()
        self.actor, self.moments = actor, None
        if normalised is not None and normalised.norm_obs:
            of, most = normalised.obs_rms, normalised.clip_obs
            moments = of.mean, np.sqrt(of.var + normalised.epsilon), most
            self.moments = [torch.as_tensor(part, dtype=torch.float32) for part in moments]
        self.low, self.high = torch.as_tensor(space.low), torch.as_tensor(space.high)

    def forward(self, obs: Tensor) -> Any:
        if self.moments is not None:
            mean, std, most = self.moments
            obs = ((obs - mean) / std).clamp(-most, most)
        if hasattr(self.actor, "get_action_dist_params"):
            mean, log_std, of_state = self.actor.get_action_dist_params(obs)
            if of_state:  # gSDE: the noise is a random linear map of the last layer
                noise, latent = self.actor.action_dist, of_state["latent_sde"]
                variance = latent.square() @ noise.get_std(log_std).square()
                log_std = (variance + noise.epsilon).log() / 2
            return mean, log_std
        return self.low + 0.5 * (self.actor(obs) + 1) * (self.high - self.low)


def export_policy(model: Any, path: str | Path) -> None:
    """Write the policy of SAC, TD3 or DDPG as TorchScript."""
    with torch.random.fork_rng(devices=[]):  # the training goes on with its own
        actor = model.policy.make_actor()  # not a deepcopy, which gSDE's last noise forbids
    actor.load_state_dict(model.actor.state_dict())
    normalised = model.get_vec_normalize_env()
    network = _Network(actor.cpu().eval(), model.action_space, normalised)
    example = torch.zeros(1, *model.observation_space.shape)
    torch.jit.trace_module(network, {"forward": example}).save(str(path))


class RecordCallback(BaseCallback, KVWriter):
    """A callback of `learn` that records rows, logged numbers, policies and replays.

    Every `every` steps the policy is kept and plays `episodes`, and the learners `weigh` weigh the
    buffer in a process of their own. `options` are those of `tom.record`; `run` is what it returns.
    A model that has learnt before goes on with its run.
    """

    def __init__(
        self,
        name: str,
        weigh: Sequence[str] = ("tom", "pmac"),
        every: int = 5000,
        episodes: int = 3,
        **options: Any,
    ) -> None:
        super().__init__()
        self._name, self._weigh, self._options = name, weigh, options
        self._every, self._episodes = every, episodes

    def _on_training_start(self) -> None:
        model: Any = self.model
        env, self._kept = model.get_env(), model.num_timesteps
        kept = {name: getattr(model, name, None) for name in SETTINGS}
        numbers = {name: value for name, value in kept.items() if isinstance(value, int | float)}
        options: dict[str, Any] = {
            "envs": env.num_envs,
            "seed": model.seed or 0,
            "steps": model._total_timesteps,
            "config": {"algorithm": type(model).__name__, **numbers},
        }
        if spec := env.get_attr("spec")[0]:
            options["env"] = spec.id
        if self._kept:
            options |= {"resume": "auto", "step": self._kept}
        self.run = record(self._name, **{**options, **self._options})
        if self._weigh:
            weigh_live(self.run, self._weigh, self._every)
        self._normalised = model.get_vec_normalize_env()
        self._obs = self._newest(model._last_obs)
        self.logger.output_formats.append(self)

    def _newest(self, obs: Any) -> NDArray:
        """The observations (E, O) that the model has just got, in the task's own units."""
        return obs.copy() if self._normalised is None else self._normalised.get_original_obs()

    def _on_step(self) -> bool:
        step, normalised = self.locals, self._normalised
        reward = step["rewards"] if normalised is None else normalised.get_original_reward()
        ended, infos, next_obs = step["dones"], step["infos"], self._newest(step["new_obs"])
        for env in np.flatnonzero(ended):
            last = infos[env]["terminal_observation"]
            next_obs[env] = last if normalised is None else normalised.unnormalize_obs(last)
        cut = ended & np.array([info.get("TimeLimit.truncated", False) for info in infos])
        action = step.get("clipped_actions", step["actions"])
        self.run.transitions(self._obs, action, reward, next_obs, ended & ~cut, cut)
        self._obs = self._newest(step["new_obs"])
        if self.num_timesteps >= self._kept + self._every:
            self._keep()
        return True

    def _on_training_end(self) -> None:
        self._keep()
        self.logger.output_formats.remove(self)
        self.run.close()

    def _keep(self) -> None:
        self._kept = self.num_timesteps
        self.run.policy(self._kept, self.model)
        if self._episodes:
            self.run.evaluate(self._kept, self._episodes)

    def write(self, key_values: Any, key_excluded: Any, step: int = 0) -> None:
        """Record the numbers that the library logs, but its times."""
        numbers = {
            METRIC_NAMES.get(str(name), str(name)): value
            for name, value in key_values.items()
            if isinstance(value, float | int | np.number) and not str(name).startswith("time/")
        }
        self.run.metrics(step, numbers)
