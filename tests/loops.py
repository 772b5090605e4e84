"""Loops of a user's own in tests: their runs loaded, and what their tasks have really done."""

from pathlib import Path

import gymnasium
import numpy as np

import tom
from tom.frames import Run
from tom.own_loop.run import record


def loaded(store: Path, name: str = "mine") -> Run:
    """A recorded run."""
    found = tom.load(name, store=store)
    assert isinstance(found, Run)
    return found


class Watched(gymnasium.Wrapper):
    """Notes every step that is taken: obs, action, reward, next_obs, terminated, truncated."""

    def __init__(self, env: gymnasium.Env) -> None:
        super().__init__(env)
        self.steps: list[tuple] = []
        self._obs = np.zeros(0)

    def reset(self, **options):
        self._obs, info = self.env.reset(**options)
        return self._obs, info

    def step(self, action):
        found = self.env.step(action)
        self.steps.append((self._obs, np.array(action), found[1], found[0], *found[2:4]))
        self._obs = found[0]
        return found


def of_two(store: Path, name: str = "two") -> Path:
    """A run of a loop of two environments, whose steps after an end only reset: 394 rows of 400."""
    rng, path = np.random.default_rng(0), store / name
    how = {"store": store, "steps": 400, "envs": 2, "autoreset": "next-step"}
    with record(name, env="InvertedPendulum-v5", **how) as run:
        for step in (200, 400):
            obs, cut = rng.normal(size=(100, 2, 4)), np.zeros((100, 2), bool)
            cut[49::50] = True
            run.transitions(obs, obs[..., :1] / 9, obs[..., 0], obs, cut & ~cut, cut)
            run.weights(step, np.arange(step) + 1.0)
            run.episode(step, rng.normal(size=(11, 4)), np.ones(10))
    return path
