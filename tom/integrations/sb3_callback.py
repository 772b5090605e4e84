"""Records a training of stable-baselines3 while it runs (docs/your-own-loop.md)."""

from collections.abc import Sequence
from typing import Any

from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import KVWriter

from tom.integrations.sb3 import logged, newest_obs, newest_steps, settings
from tom.own_loop.live import weigh_live
from tom.own_loop.run import record


class RecordCallback(BaseCallback, KVWriter):
    """A callback of `learn` that records rows, logged numbers, policies and replays.

    Every `every` steps the policy is kept and plays `episodes`, and the learners `weigh` weigh the
    buffer in a process of their own. `options` are those of `tom.record`; `run` is what it returns.
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
        self._kept = self.model.num_timesteps
        self.run = record(self._name, **{**settings(self.model), **self._options})
        if self._weigh:
            weigh_live(self.run, self._weigh, self._every)
        self._obs = newest_obs(self.model, self.model._last_obs)
        self.logger.output_formats.append(self)

    def _on_step(self) -> bool:
        self.run.transitions(self._obs, *newest_steps(self.model, self.locals))
        self._obs = newest_obs(self.model, self.locals["new_obs"])
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
        self.run.metrics(step, logged(key_values))
