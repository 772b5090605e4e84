"""The MuJoCo tasks: dimensions, names, action range, seeds, time limit, poses."""

import os
import re
import subprocess
import sys

import numpy as np
import pytest
import torch
from gymnasium.envs.mujoco import MujocoEnv
from gymnasium.spaces import Box

from tom.envs import ENV_NAMES, ENVS, task
from tom.errors import UserError

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


def test_registry():
    assert set(ENVS) == set(DIMENSIONS)
    assert list(ENV_NAMES) == [*ENVS, "road-and-rocks"]
    assert task("ant") is ENVS["ant"]
    with pytest.raises(UserError, match="did you mean 'hopper'"):
        task("hoper")


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
    hinges = joints[1 if name in ("ant", "humanoid") else 3 :]
    if name == "halfcheetah":
        hinges = [{"b": "back ", "f": "front "}[j[0]] + j[1:] for j in hinges]
    for part in ("angle", "angular velocity"):
        named = [n.removesuffix(part) for n in t.obs_names if n.endswith(part) and "torso" not in n]
        assert [words(n) for n in named] == [words(j) for j in hinges]


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


def test_the_time_limit_truncates_and_does_not_terminate():
    """In the task where termination is possible, too: a linear controller keeps the pole up."""
    t = ENVS["inverted-pendulum"]
    env = t.make()
    obs, _ = env.reset(seed=0)
    for step in range(1, 1001):
        action = np.clip(obs @ [[0.2], [6.0], [0.4], [1.0]], -1, 1).astype(np.float32)
        obs, _, terminated, truncated, _ = env.step(action)
        assert not terminated
        assert truncated == (step == 1000)
        assert not t.terminated(torch.as_tensor(obs, dtype=torch.float32)[None]).item()


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


def test_importing_and_stepping_needs_no_display_and_writes_no_log(tmp_path):
    code = "from tom.envs import ENVS; [t.make(seed=0) for t in ENVS.values()]"
    clean = {k: v for k, v in os.environ.items() if k not in ("DISPLAY", "MUJOCO_GL")}
    subprocess.run([sys.executable, "-c", code], check=True, cwd=tmp_path, env=clean)
    assert list(tmp_path.iterdir()) == []
