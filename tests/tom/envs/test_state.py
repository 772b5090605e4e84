"""A captured environment, restored elsewhere, takes the very same steps."""

import gymnasium as gym
import numpy as np
import pytest
from common import reloaded
from gymnasium.wrappers import RecordEpisodeStatistics

from tom.envs import ENVS
from tom.envs.environment import capture, restore


def play(env: gym.Env, steps: int) -> list[np.ndarray]:
    """Random steps, with resets in between, as rows of all that the environment answers."""
    rows = []
    for _ in range(steps):
        obs, reward, terminated, truncated, _ = env.step(env.action_space.sample())
        rows.append(np.concatenate((obs, [float(reward), terminated, truncated])))
        if terminated or truncated:
            rows.append(env.reset()[0])
    return rows


@pytest.mark.parametrize("name", ENVS)
def test_resumed_steps_are_bit_identical(name):
    env = ENVS[name].make(seed=3)
    play(env, 53)
    state = reloaded(capture(env))
    expected = play(env, 120)  # capturing changes nothing
    other = ENVS[name].make(seed=99)
    play(other, 7)
    restore(other, state)
    for left, right in zip(expected, play(other, 120), strict=True):
        np.testing.assert_array_equal(left, right)


def test_elapsed_steps_are_part_of_the_state():
    env = ENVS["halfcheetah"].make(seed=0)
    play(env, 990)
    other = ENVS["halfcheetah"].make(seed=1)
    restore(other, capture(env))
    truncated = [bool(row[-1]) for row in play(other, 10)[:10]]
    assert truncated == [False] * 9 + [True]


def test_unknown_wrapper_is_refused():
    env = RecordEpisodeStatistics(ENVS["hopper"].make(seed=0))
    with pytest.raises(TypeError, match="RecordEpisodeStatistics"):
        capture(env)
