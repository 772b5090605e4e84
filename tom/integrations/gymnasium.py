"""Gymnasium's environments, one or a vector of them, that record their steps as they take them.

    env = RecordEnv(gymnasium.make("Hopper-v5"), "my-sac")  # env.run: as of tom.record
    envs = RecordVectorEnv(gymnasium.make_vec("Hopper-v5", num_envs=4), "my-sac")

`options` are those of `tom.record`; `close` ends the record. Put them around wrappers that record
statistics, and inside those that change observations, actions or rewards.
"""

from typing import Any

import gymnasium as gym
from gymnasium.vector import AutoresetMode, VectorEnv, VectorWrapper

from tom.own_loop.run import record

MODES = {AutoresetMode.NEXT_STEP: "next-step", AutoresetMode.SAME_STEP: "same-step"}


def _task(env: gym.Env | VectorEnv, options: dict[str, Any]) -> dict[str, Any]:
    return options if "env" in options or env.spec is None else {"env": env.spec.id, **options}


class RecordEnv(gym.Wrapper):
    """An environment whose steps are recorded."""

    def __init__(self, env: gym.Env, name: str, **options: Any) -> None:
        super().__init__(env)
        self.run, self._obs = record(name, **_task(env, options)), None

    def reset(self, **options: Any) -> tuple[Any, dict[str, Any]]:
        self._obs, info = self.env.reset(**options)
        return self._obs, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        found = self.env.step(action)
        obs, reward, terminated, truncated, _ = found
        self.run.transitions(self._obs, action, reward, obs, terminated, truncated)
        self._obs = obs
        return found

    def close(self) -> None:
        self.run.close()
        self.env.close()


class RecordVectorEnv(VectorWrapper):
    """A vector environment whose steps are recorded, in each of Gymnasium's modes of autoreset."""

    def __init__(self, env: VectorEnv, name: str, **options: Any) -> None:
        super().__init__(env)
        kind = env.metadata.get("autoreset_mode")
        mode = None if kind is None else MODES.get(kind)
        own = {"envs": env.num_envs, "autoreset": mode, **_task(env, options)}
        self.run, self._obs = record(name, **own), None

    def reset(self, **options: Any) -> tuple[Any, dict[str, Any]]:
        self._obs, infos = self.env.reset(**options)
        return self._obs, infos

    def step(self, actions: Any) -> tuple[Any, Any, Any, Any, dict[str, Any]]:
        found = self.env.step(actions)
        self.run.transitions(self._obs, actions, found[1], found[0], *found[2:])
        self._obs = found[0]
        return found

    def close(self, **options: Any) -> None:
        self.run.close()
        self.env.close(**options)
