"""The MuJoCo tasks: dimensions, names, seeds, time limit, states, geometry, ends of episodes."""

import re

import gymnasium as gym
import mujoco
import numpy as np
import pytest
import torch
from common import reloaded
from gymnasium.envs.mujoco import MujocoEnv
from gymnasium.spaces import Box

from tom.envs import ENVS, scene
from tom.envs.environment import capture, restore

DIMENSIONS = {  # obs, action
    "inverted-pendulum": (4, 1),
    "hopper": (11, 3),
    "walker2d": (17, 6),
    "halfcheetah": (17, 6),
    "ant": (27, 8),
    "humanoid": (45, 17),
}


def simulator(env) -> MujocoEnv:
    assert isinstance(env.unwrapped, MujocoEnv)
    return env.unwrapped


@pytest.mark.parametrize("name", ENVS)
def test_dimensions_names_and_limits_are_the_environments(name):
    t = ENVS[name]
    env = t.make()
    assert (t.obs_dim, t.action_dim) == DIMENSIONS[name]
    assert env.observation_space.shape == (t.obs_dim,)
    assert env.action_space.shape == (t.action_dim,)
    assert len(set(t.obs_names)) == t.obs_dim
    model = simulator(env).model
    assert t.nq == model.nq
    assert t.obs_dim == model.nq - t.root_dims + model.nv
    assert env.spec is not None
    assert env.spec.max_episode_steps == t.max_episode_steps == 1000


@pytest.mark.parametrize("name", [n for n in ENVS if n != "inverted-pendulum"])
def test_names_follow_the_order_of_the_joints(name):
    t = ENVS[name]
    model = simulator(t.make()).model
    joints = [model.joint(j).name for j in range(model.njnt)]
    if name == "halfcheetah":
        joints = [{"b": "back ", "f": "front "}.get(j[0], "") + j[1:] for j in joints]
    hinges = joints[1 if name in ("ant", "humanoid") else 3 :]
    for part in ("angle", "angular velocity"):
        named = [n.removesuffix(part) for n in t.obs_names if n.endswith(part) and "torso" not in n]
        assert [words(n) for n in named] == [words(j) for j in hinges]
    moved = [joints[j] for j in model.actuator_trnid[:, 0]]
    assert [words(n) - {"torque"} for n in t.action_names] == [words(j) for j in moved]


def words(name: str) -> set[str]:
    return set(re.findall(r"[a-z]+|\d", name)) - {"joint", "right"}  # walker2d's right is unnamed


@pytest.mark.parametrize("name", ENVS)
def test_actions_of_one_reach_the_simulators_bounds_exactly(name):
    env = ENVS[name].make(seed=0)
    sim = simulator(env)
    low, high = sim.model.actuator_ctrlrange.astype(np.float32).T
    assert env.action_space == Box(-1.0, 1.0, (len(low),), np.float32)
    for action, wanted in ((-1.0, low), (0.0, (low + high) / 2), (1.0, high), (0.5, high / 2)):
        env.step(np.full(len(low), action, np.float32))
        np.testing.assert_allclose(sim.data.ctrl, wanted, rtol=1e-6, atol=1e-7)
        assert (sim.data.ctrl >= low).all()
        assert (sim.data.ctrl <= high).all()


@pytest.mark.parametrize("name", ENVS)
def test_a_pose_is_drawn_again_from_an_observation(name):
    t = ENVS[name]
    env = t.make(seed=6)
    rows = [env.step(env.action_space.sample())[0] for _ in range(5)]
    qpos = t.qpos_from_obs(np.array(rows))
    assert qpos.shape == (5, t.nq)
    assert (qpos[:, : t.root_dims] == 0).all()
    np.testing.assert_array_equal(qpos[-1, t.root_dims :], simulator(env).data.qpos[t.root_dims :])
    np.testing.assert_array_equal(t.qpos_from_obs(np.array(rows)[2]), qpos[2])


# A captured environment, restored elsewhere, takes the very same steps


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


# Geometry

mj = scene._mj


@pytest.mark.parametrize("env", list(ENVS))
def test_geometry_is_where_mujoco_itself_puts_it(env: str):
    model = scene.model(env).mj
    qpos = model.qpos0 + np.random.default_rng(0).normal(0, 0.3, (5, model.nq))
    drawn = scene.geometry(model, qpos)
    kinds = {scene.CAPSULE: drawn.capsules, scene.SPHERE: drawn.ellipsoids}
    data = mj.MjData(model)
    for frame, position in enumerate(qpos):
        data.qpos[:] = position
        mj.mj_forward(model, data)
        np.testing.assert_allclose(drawn.root[frame], data.xpos[1], atol=1e-5)
        for kind, shape in kinds.items():
            for k, geom in enumerate(np.flatnonzero(model.geom_type == kind)):
                rotation = data.geom_xmat[geom].reshape(3, 3)
                center = data.geom_xpos[geom]
                np.testing.assert_allclose(shape.center[frame, k], center, atol=1e-5)
                if kind == scene.CAPSULE:
                    end = center - rotation[:, 2] * model.geom_size[geom, 1]
                    np.testing.assert_allclose(shape.capsule_end[frame, k], end, atol=1e-5)
                x, y, z, w = shape.quaternion[frame, k].astype(float)
                back = np.zeros(9)
                mujoco.mju_quat2Mat(back, np.array([w, x, y, z]))  # pyright: ignore
                np.testing.assert_allclose(back.reshape(3, 3), rotation, atol=1e-5)


# Termination functions: both sides of every bound, and the environments' own answers

NAN, INF = float("nan"), float("inf")
HEALTHY = {"hopper": 1.2, "walker2d": 1.2, "ant": 0.7, "humanoid": 1.4}
"""a height at which a robot has not fallen, its first observation"""
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


@pytest.mark.parametrize(("name", "dimension", "value", "ends"), CASES)
def test_both_sides_of_every_bound(name, dimension, value, ends):
    obs = torch.zeros(3, ENVS[name].obs_dim)
    obs[:, 0] = HEALTHY.get(name, 0.0)
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
