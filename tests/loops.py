"""Loops of a user's own in tests: their runs loaded, and what their tasks have really done."""

from pathlib import Path

import gymnasium
import numpy as np

import tom
from tom.frames import Run


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
