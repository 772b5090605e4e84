"""The policy in the real task: steps with the simulator's state, and evaluation episodes."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from gymnasium import Env
from numpy.typing import NDArray
from torch import Tensor

from tom.data.transitions import Transitions
from tom.envs.environment import capture, restore, simulated
from tom.envs.task import Task
from tom.events import Episode
from tom.learners.base import Policy


class Step(NamedTuple):
    """One transition, the simulator's state at its obs, and the episode up to this step.

    The state is empty if there is no simulator.
    """

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

    def __init__(self, task: Task, seed: int) -> None:
        self._env = task.make()
        simulator = simulated(self._env)
        self._data = None if simulator is None else simulator.data
        self.obs = self._env.reset(seed=seed)[0]
        self._return, self._length = 0.0, 0

    def step(self, action: NDArray) -> Step:
        """Take `action` (A,) in [-1, 1]; after the last step a new episode starts automatically."""
        obs, qpos, qvel = self.obs, np.zeros(0), np.zeros(0)
        if self._data is not None:
            qpos, qvel = self._data.qpos.copy(), self._data.qvel.copy()
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
        """The state of the episode, as tensors and primitives."""
        return {
            "env": capture(self._env),
            "obs": torch.from_numpy(self.obs),
            "episode": [self._return, float(self._length)],
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Continue that episode exactly."""
        restore(self._env, state["env"])
        self.obs = state["obs"].numpy()
        self._return, length = state["episode"]
        self._length = int(length)


@dataclass(frozen=True)
class Footprint:
    """A policy's transitions in the real environment and the returns of its whole episodes."""

    transitions: Transitions
    returns: tuple[float, ...]


def footprint(
    task: Task,
    policy: Policy,
    rows: int,
    seed: int,
    generator: torch.Generator,
    stepped: Callable[[], None] = lambda: None,
) -> Footprint:
    """The first `rows` transitions of fresh episodes under the policy's sampled actions.

    `seed` determines the environment's start states, `generator` the actions. If the last episode
    is cut short, its last row is marked as truncated. `stepped` is called after each step.
    """
    collector = Collector(task, seed)
    steps: list[Step] = []
    while len(steps) < rows:
        obs = torch.as_tensor(collector.obs, dtype=torch.float32)[None]
        steps.append(collector.step(policy(obs, 1, generator)[0, 0].numpy()))
        stepped()
    return Footprint(
        transitions_of(steps, cut=True), tuple(s.episode_return for s in steps if s.ended)
    )


def transitions_of(steps: Sequence[Step], *, cut: bool) -> Transitions:
    """The steps as transitions in float32; with `cut` the last row is marked as truncated."""
    obs, action, reward, next_obs, terminated, truncated = (
        np.array([step[i] for step in steps]) for i in range(6)
    )
    truncated[-1] |= cut and not terminated[-1]
    obs, action, reward, next_obs = (a.astype(np.float32) for a in (obs, action, reward, next_obs))
    return Transitions(obs, action, reward, next_obs, terminated, truncated)


class Evaluator:
    """Plays episodes in lock-step, so that one forward pass serves all running episodes.

    It keeps its environments between evaluations; an evaluation depends only on the policy and the
    seed, never on earlier evaluations or on the training's environment.
    """

    def __init__(self, task: Task, episodes: int) -> None:
        self._envs = [task.make() for _ in range(episodes)]

    def run(self, policy_mean: Callable[[Tensor], Tensor], seed: int) -> list[Episode]:
        """An episode each, to its end or limit; `policy_mean`: obs (B, O) -> (B, A) in [-1, 1]."""
        seeds = np.random.SeedSequence(seed).generate_state(len(self._envs)).tolist()
        running = tapes = [_Tape(*args) for args in zip(self._envs, seeds, strict=True)]
        while running:
            obs = torch.from_numpy(np.stack([tape.obs for tape in running]))
            with torch.no_grad():
                actions = policy_mean(obs).cpu().numpy()
            for tape, action in zip(running, actions, strict=True):
                tape.step(action)
            running = [tape for tape in running if not (tape.terminated or tape.truncated)]
        return [tape.episode() for tape in tapes]


class _Tape:
    """An episode in an environment, and its record."""

    def __init__(self, env: Env, seed: int) -> None:
        self._env, self._simulator = env, simulated(env)
        self.terminated = self.truncated = False
        self._steps: list[tuple[NDArray, float]] = []
        self._states: list[tuple[NDArray, ...]] = []
        self._note(env.reset(seed=seed)[0])

    @property
    def obs(self) -> NDArray:
        return self._states[-1][0]

    def step(self, action: NDArray) -> None:
        obs, reward, self.terminated, self.truncated, _ = self._env.step(action)
        self._steps.append((action, float(reward)))
        self._note(obs)

    def episode(self) -> Episode:
        action, reward = (np.array(part, np.float32) for part in zip(*self._steps, strict=True))
        obs, *joints = (np.array(part) for part in zip(*self._states, strict=True))
        qpos, qvel = joints or (None, None)
        return Episode(
            reward, action, obs, qpos, qvel, terminated=self.terminated, truncated=self.truncated
        )

    def _note(self, obs: NDArray) -> None:
        """Keep an observation, and the positions and velocities of the joints there."""
        data = None if self._simulator is None else self._simulator.data
        joints = () if data is None else (data.qpos, data.qvel)
        self._states.append(tuple(np.array(part, np.float32) for part in (obs, *joints)))
