"""Steps taken in a real environment, with the simulator's state beside each of them."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from gymnasium.envs.mujoco import MujocoEnv
from numpy.typing import NDArray

from tom.data.transitions import Transitions
from tom.envs.mujoco import MujocoTask
from tom.envs.state import capture, restore
from tom.learners.base import Policy


class Step(NamedTuple):
    """One transition, the simulator's state at its obs, and the episode so far (this step too)."""

    obs: NDArray
    action: NDArray
    reward: float
    next_obs: NDArray
    terminated: bool
    truncated: bool
    qpos: NDArray
    qvel: NDArray
    episode_return: float
    episode_length: int

    @property
    def ended(self) -> bool:
        return self.terminated or self.truncated


class Collector:
    """One environment of `task`, stepped through episode after episode."""

    def __init__(self, task: MujocoTask, seed: int) -> None:
        self._env = task.make()
        simulator = self._env.unwrapped
        assert isinstance(simulator, MujocoEnv)
        self._data = simulator.data
        self.obs = self._env.reset(seed=seed)[0]
        self._return, self._length = 0.0, 0

    def step(self, action: NDArray) -> Step:
        """Take `action` (A,) in [-1, 1]; a new episode begins by itself after the last step."""
        obs, qpos, qvel = self.obs, self._data.qpos.copy(), self._data.qvel.copy()
        next_obs, reward, terminated, truncated, _ = self._env.step(action)
        self._return += float(reward)
        self._length += 1
        row = (obs, action, float(reward), next_obs, terminated, truncated, qpos, qvel)
        step = Step(*row, self._return, self._length)
        self.obs = next_obs
        if step.ended:
            self.obs = self._env.reset()[0]
            self._return, self._length = 0.0, 0
        return step

    def state_dict(self) -> dict[str, Any]:
        """Where the episode stands, as tensors and primitives."""
        return {
            "env": capture(self._env),
            "obs": torch.from_numpy(self.obs),
            "episode": [self._return, float(self._length)],
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go on with that episode, to the last bit."""
        restore(self._env, state["env"])
        self.obs = state["obs"].numpy()
        self._return, length = state["episode"]
        self._length = int(length)


@dataclass(frozen=True)
class Footprint:
    """What a policy does in the real environment: its transitions and whole episodes' returns."""

    transitions: Transitions
    returns: tuple[float, ...]


def footprint(
    task: MujocoTask, policy: Policy, rows: int, seed: int, generator: torch.Generator
) -> Footprint:
    """The first `rows` transitions of fresh episodes under the policy's sampled actions.

    The environment's start states follow `seed`, the actions `generator`. Where the last episode
    is cut short, its last row is truncated.
    """
    collector = Collector(task, seed)
    steps: list[Step] = []
    while len(steps) < rows:
        obs = torch.as_tensor(collector.obs, dtype=torch.float32)[None]
        steps.append(collector.step(policy(obs, 1, generator)[0, 0].numpy()))
    return Footprint(
        transitions_of(steps, cut=True), tuple(s.episode_return for s in steps if s.ended)
    )


def transitions_of(steps: Sequence[Step], *, cut: bool) -> Transitions:
    """The steps as transitions in float32; `cut` ends the recording: its last row is truncated."""
    obs, action, reward, next_obs, terminated, truncated = (
        np.array([step[i] for step in steps]) for i in range(6)
    )
    truncated[-1] |= cut and not terminated[-1]
    obs, action, reward, next_obs = (a.astype(np.float32) for a in (obs, action, reward, next_obs))
    return Transitions(obs, action, reward, next_obs, terminated, truncated)
