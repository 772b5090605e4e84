"""Gymnasium's environments, one or a vector of them, that record their steps as they take them.

    env = RecordEnv(gymnasium.make("Hopper-v5"), "my-sac")  # env.run: as of tom.record
    envs = RecordVectorEnv(gymnasium.make_vec("Hopper-v5", num_envs=4), "my-sac")

`options` are those of `tom.record`; `close` ends the record. Put them around wrappers that record
statistics, and inside those that change observations, actions or rewards.
"""

from copy import deepcopy
from typing import Any

import gymnasium as gym
from gymnasium.vector import AutoresetMode, VectorEnv, VectorWrapper

from tom.own_loop.run import OwnRun, record

MODES = {AutoresetMode.NEXT_STEP: "next-step", AutoresetMode.SAME_STEP: "same-step"}


class _Recorded:
    """Records the steps of the wrapper that it is mixed into."""

    env: Any
    run: OwnRun

    def reset(self, **options: Any) -> tuple[Any, dict[str, Any]]:
        if "reset_mask" not in (options.get("options") or {}):  # else of some environments
            self.run.cut()
        obs, info = self.env.reset(**options)
        self._obs = deepcopy(obs)  # the environment may change its own in the next step
        return obs, info

    def step(self, action: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        found = self.env.step(action)
        self.run.transitions(self._obs, action, found[1], found[0], *found[2:])
        self._obs = deepcopy(found[0])
        return found

    def close(self, **options: Any) -> None:
        self.run.close()
        self.env.close(**options)


class RecordEnv(_Recorded, gym.Wrapper):
    def __init__(self, env: gym.Env, name: str, **options: Any) -> None:
        super().__init__(env)
        own: dict[str, Any] = {"env": env.spec.id} if env.spec else {}
        self.run = record(name, **own | options)


class RecordVectorEnv(_Recorded, VectorWrapper):  # pyright: ignore[reportIncompatibleMethodOverride]
    """A vector environment whose steps are recorded, in each of Gymnasium's modes of autoreset."""

    def __init__(self, env: VectorEnv, name: str, **options: Any) -> None:
        super().__init__(env)
        mode = env.metadata.get("autoreset_mode", AutoresetMode.DISABLED)
        own: dict[str, Any] = {"envs": env.num_envs, "autoreset": MODES.get(mode)}
        own |= {"env": env.spec.id} if env.spec else {}
        self.run = record(name, **own | options)
