"""Termination functions: both sides of every bound, and the real environments' own answers."""

import numpy as np
import pytest
import torch
from gymnasium.envs.mujoco import MujocoEnv

from tom.envs import ENVS
from tom.envs.environment import capture, restore

NAN, INF = float("nan"), float("inf")
HEALTHY = {
    "inverted-pendulum": {},
    "hopper": {0: 1.2},
    "walker2d": {0: 1.2},
    "halfcheetah": {},
    "ant": {0: 0.7},
    "humanoid": {0: 1.4},
}
# (task, dimension, value, does it end?)
CASES = [
    *[("inverted-pendulum", 1, v, abs(v) > 0.2) for v in (0.199, 0.201, -0.199, -0.201)],
    *[("inverted-pendulum", d, v, True) for d in (0, 3) for v in (NAN, INF, -INF)],
    ("inverted-pendulum", 0, 50.0, False),
    *[("hopper", 0, v, v <= 0.7) for v in (0.699, 0.7, 0.701, 90.0, 150.0)],
    *[("hopper", 1, v, abs(v) >= 0.2) for v in (0.199, 0.2, 0.201, -0.199, -0.2, -0.201)],
    *[
        ("hopper", d, v, abs(v) >= 100)
        for d in (2, 5, 10)
        for v in (99.9, 100.0, 100.1, -99.9, -100.0, -100.1)
    ],
    *[("hopper", d, v, True) for d in (0, 4, 10) for v in (NAN, INF, -INF)],
    *[("walker2d", 0, v, not 0.8 < v < 2.0) for v in (0.799, 0.801, 1.999, 2.001, NAN, INF)],
    *[("walker2d", 1, v, not abs(v) < 1) for v in (0.999, 1.0, 1.001, -0.999, -1.001, NAN)],
    ("walker2d", 5, 500.0, False),
    *[("halfcheetah", d, v, False) for d in (0, 1, 16) for v in (-99.0, 0.0, 1e6)],
    *[("ant", 0, v, not 0.2 <= v <= 1.0) for v in (0.199, 0.2, 0.201, 0.999, 1.0, 1.001)],
    *[("ant", d, v, True) for d in (0, 7, 26) for v in (NAN, INF, -INF)],
    ("ant", 9, -500.0, False),
    *[("humanoid", 0, v, not 1.0 <= v <= 2.0) for v in (0.999, 1.0, 1.001, 1.999, 2.0, 2.001)],
    ("humanoid", 0, NAN, True),
    ("humanoid", 30, 500.0, False),
]


def healthy(name: str) -> torch.Tensor:
    obs = torch.zeros(ENVS[name].obs_dim)
    for dimension, value in HEALTHY[name].items():
        obs[dimension] = value
    return obs


@pytest.mark.parametrize(("name", "dimension", "value", "ends"), CASES)
def test_both_sides_of_every_bound(name, dimension, value, ends):
    obs = healthy(name).repeat(3, 1)
    obs[1, dimension] = value
    assert ENVS[name].terminated(obs).tolist() == [False, ends, False]


@pytest.mark.parametrize("name", ENVS)
def test_agrees_with_the_environment_from_scattered_states(name):
    """States thrown widely about, so that every kind of ending occurs in the real simulator."""
    task, rng = ENVS[name], np.random.default_rng(0)
    env = task.make(seed=2)
    simulator = env.unwrapped
    assert isinstance(simulator, MujocoEnv)
    start = capture(env)
    agreed = []
    for _ in range(150):
        restore(env, start)
        data = simulator.data
        qpos = data.qpos + rng.normal(size=data.qpos.size) * 0.4
        simulator.set_state(qpos, data.qvel + rng.normal(size=data.qvel.size))
        obs, _, terminated, _, _ = env.step(env.action_space.sample())
        ours = task.terminated(torch.as_tensor(obs, dtype=torch.float32)[None]).item()
        agreed.append((ours, terminated))
    assert all(ours == theirs for ours, theirs in agreed)
    assert {theirs for _, theirs in agreed} == {False, name != "halfcheetah"}
