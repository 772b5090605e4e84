"""Evaluation episodes of a policy, in separate environments."""

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from tom.envs.environment import simulated
from tom.envs.task import Task
from tom.events import Episode

PolicyMean = Callable[[Tensor], Tensor]
"""obs (B, O) float32 -> the policy's mean actions (B, A) in [-1, 1]."""


class Evaluator:
    """Plays episodes in lock-step, so that one forward pass serves all running episodes.

    It keeps its environments between evaluations; an evaluation depends only on the policy and the
    seed, never on earlier evaluations or on the training's environment.
    """

    def __init__(self, task: Task, episodes: int) -> None:
        self._tapes = [_Tape(task) for _ in range(episodes)]

    def run(self, policy_mean: PolicyMean, seed: int) -> list[Episode]:
        """One episode in each environment, to its end or time limit."""
        seeds = np.random.SeedSequence(seed).generate_state(len(self._tapes))
        for tape, reset_seed in zip(self._tapes, seeds, strict=True):
            tape.begin(int(reset_seed))
        running = self._tapes
        while running:
            obs = torch.from_numpy(np.stack([tape.obs for tape in running]))
            with torch.no_grad():
                actions = policy_mean(obs).cpu().numpy()
            for tape, action in zip(running, actions, strict=True):
                tape.step(action)
            running = [tape for tape in running if not tape.ended]
        return [tape.episode() for tape in self._tapes]


class _Tape:
    """One environment and the record of its current episode."""

    def __init__(self, task: Task) -> None:
        self._env = task.make()
        simulator = simulated(self._env)
        self._data = None if simulator is None else simulator.data
        steps = task.max_episode_steps
        self._obs = np.empty((steps + 1, task.obs_dim), np.float32)
        nq, nv = (0, 0) if self._data is None else (self._data.qpos.size, self._data.qvel.size)
        self._qpos = np.empty((steps + 1, nq), np.float32)
        self._qvel = np.empty((steps + 1, nv), np.float32)
        self._action = np.empty((steps, task.action_dim), np.float32)
        self._reward = np.empty(steps, np.float32)
        self._length = 0
        self._terminated = self._truncated = False

    @property
    def obs(self) -> np.ndarray:
        return self._obs[self._length]

    @property
    def ended(self) -> bool:
        return self._terminated or self._truncated

    def begin(self, seed: int) -> None:
        obs, _ = self._env.reset(seed=seed)
        self._length = 0
        self._terminated = self._truncated = False
        self._write_state(obs)

    def step(self, action: np.ndarray) -> None:
        obs, reward, self._terminated, self._truncated, _ = self._env.step(action)
        self._action[self._length] = action
        self._reward[self._length] = reward
        self._length += 1
        self._write_state(obs)

    def episode(self) -> Episode:
        h = self._length
        return Episode(
            reward=self._reward[:h].copy(),
            action=self._action[:h].copy(),
            obs=self._obs[: h + 1].copy(),
            qpos=None if self._data is None else self._qpos[: h + 1].copy(),
            qvel=None if self._data is None else self._qvel[: h + 1].copy(),
            terminated=self._terminated,
            truncated=self._truncated,
        )

    def _write_state(self, obs: np.ndarray) -> None:
        self._obs[self._length] = obs
        if self._data is not None:
            self._qpos[self._length] = self._data.qpos
            self._qvel[self._length] = self._data.qvel
