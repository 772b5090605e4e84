"""Records a training of stable-baselines3 while it runs (docs/your-own-loop.md)."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import KVWriter

from tom.errors import UserError
from tom.own_loop.live import weigh_live
from tom.own_loop.run import OwnRun, record

OURS = {
    "eval/mean_reward": "eval/return",
    "train/critic_loss": "critic/loss",
    "train/actor_loss": "actor/loss",
    "train/ent_coef": "temperature/value",
}
"""the library's names of what has a name here"""
SETTINGS = ("learning_rate", "batch_size", "gamma", "tau", "buffer_size", "learning_starts")


class RecordCallback(BaseCallback, KVWriter):
    """A callback of `learn` that records rows, logged numbers, policies and replays.

    Every `every` steps the policy is kept and plays `episodes` (0: none), and the learners `weigh`
    weigh the buffer in a process of their own (empty: none). `options` are `tom.record`'s; a model
    that has learnt before goes on with the run. `run` is what `tom.record` returned.
    """

    run: OwnRun
    _played = -1

    def __init__(
        self,
        name: str,
        store: str = "runs",
        weigh: Sequence[str] = ("tom", "pmac"),
        every: int = 5000,
        episodes: int = 3,
        **options: Any,
    ) -> None:
        super().__init__()
        self._name, self._weigh, self._every, self._episodes = name, weigh, every, episodes
        self._options = {"store": store, **options}

    def _on_training_start(self) -> None:
        model, env = self.model, self.training_env
        spec, at = env.get_attr("spec")[0], model.num_timesteps
        if spec is None and "env" not in self._options:
            raise UserError("the task has no Gymnasium id: RecordCallback(..., env='module:Id-v0')")
        config = {name: getattr(model, name, None) for name in SETTINGS}
        config = {k: v for k, v in config.items() if isinstance(v, int | float)}
        own = {"seed": model.seed or 0, "steps": model._total_timesteps, "envs": env.num_envs}
        own |= {"config": {"algorithm": type(model).__name__, **config}}
        own |= {"env": spec.id} if spec else {}
        going_on = {"resume": "auto", "step": at} if at else {}
        self.run = record(self._name, **{**own, **going_on, **self._options})
        if self._weigh:
            weigh_live(self.run, self._weigh, self._every)
        self._normalised = model.get_vec_normalize_env()
        self._obs, self._due = self._own(model._last_obs), at + self._every
        self.logger.output_formats.append(self)

    def _on_step(self) -> bool:
        step, normalised = self.locals, self._normalised
        obs = self._own(step["new_obs"])
        ended, infos, next_obs = step["dones"], step["infos"], obs.copy()
        for env in np.flatnonzero(ended):
            last = infos[env]["terminal_observation"]
            next_obs[env] = last if normalised is None else normalised.unnormalize_obs(last)
        cut = np.array([info.get("TimeLimit.truncated", False) for info in infos]) & ended
        reward = step["rewards"] if normalised is None else normalised.get_original_reward()
        action = step.get("clipped_actions", step["actions"])
        self.run.transitions(self._obs, action, reward, next_obs, ended & ~cut, cut)
        self._obs = obs
        if self.num_timesteps >= self._due:
            self._due += self._every
            self._keep()
        return True

    def _on_training_end(self) -> None:
        self._keep()
        self.logger.output_formats.remove(self)
        self.run.close()

    def _keep(self) -> None:
        step = self.num_timesteps
        self.run.policy(step, self.model)
        if self._episodes and step > self._played:
            self.run.evaluate(step, self._episodes)
            self._played = step

    def _own(self, obs: Any) -> np.ndarray:
        """Observations (E, O) in the task's own units."""
        own = obs if self._normalised is None else self._normalised.get_original_obs()
        return np.array(own)

    def write(
        self, key_values: Mapping[str, Any], key_excluded: Mapping[str, Any], step: int = 0
    ) -> None:
        """Take what the library logs."""
        numbers = {k: v for k, v in key_values.items() if isinstance(v, float | int | np.number)}
        kept = {OURS.get(k, k): v for k, v in numbers.items() if not k.startswith("time/")}
        self.run.metrics(step, kept)

    def close(self) -> None:
        """Nothing is held open for the library's logger."""
