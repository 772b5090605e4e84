"""Buffers and policies of stable-baselines3, exported: what was done in the task, row for row."""

from pathlib import Path

import gymnasium
import numpy as np
import pytest
import torch
from loops import Watched
from stable_baselines3 import SAC, TD3
from stable_baselines3.common.vec_env import DummyVecEnv

from tom.data.datasets import read_dataset
from tom.data.transitions import Transitions
from tom.integrations.sb3 import export_buffer, export_policy

LIMITS = {"Pendulum-v1": 40, "InvertedPendulum-v5": 30}


def learnt(env: str, steps: int, envs: int = 1, size: int = 1000, **buffer: bool):
    """A model after `steps` steps in each of its environments, and what these have noted."""
    watched = [Watched(gymnasium.make(env, max_episode_steps=LIMITS[env])) for _ in range(envs)]
    together = DummyVecEnv([lambda one=one: one for one in watched])
    model = SAC(
        "MlpPolicy", together, learning_starts=90 * envs,
        buffer_size=size, batch_size=16, seed=0, policy_kwargs={"net_arch": [8]},
        replay_buffer_kwargs={k: v for k, v in buffer.items() if k.startswith("handle")},
        optimize_memory_usage=buffer.get("optimize_memory_usage", False),
    )  # fmt: skip
    model.learn(steps * envs)
    return model, [one.steps for one in watched]


def same(rows: Transitions, steps: list[tuple]) -> None:
    """The rows are these steps; whatever comes last is the end of an episode."""
    obs, action, reward, next_obs, terminated, truncated = map(np.array, zip(*steps, strict=True))
    truncated[-1] |= not terminated[-1]
    for name, values in {
        "obs": obs,
        "action": action,
        "next_obs": next_obs,
        "reward": reward,
    }.items():
        np.testing.assert_allclose(getattr(rows, name), values, rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(rows.terminated, terminated)
    np.testing.assert_array_equal(rows.truncated, truncated & ~terminated)


@pytest.mark.parametrize(
    ("env", "envs", "flag"),
    [("Pendulum-v1", 3, True), ("InvertedPendulum-v5", 3, False), ("Pendulum-v1", 1, False)],
)
def test_a_buffer_is_what_was_done_in_each_environment(env, envs, flag, tmp_path: Path):
    model, steps = learnt(env, 110, envs, handle_timeout_termination=flag)
    export_buffer(model, tmp_path / "buffer.npz")
    recording = read_dataset(tmp_path / "buffer.npz")
    for number, own in enumerate(steps):
        same(recording.rows[number * 110 : (number + 1) * 110], own)
    assert np.abs(recording.rows.action).max() > 1  # in the task's own units
    assert recording.card.notices() == ()


def test_a_full_buffer_begins_with_its_oldest_row(tmp_path: Path):
    model, [steps] = learnt("Pendulum-v1", 110, size=75)
    export_buffer(model, tmp_path / "whole.npz")
    same(read_dataset(tmp_path / "whole.npz").rows, steps[-75:])
    model, [steps] = learnt("Pendulum-v1", 110, size=75, handle_timeout_termination=False)
    with pytest.warns(UserWarning, match="5 of 75"):
        export_buffer(model, tmp_path / "cut.npz")  # row 35 is the 36th of its episode of 40
    same(read_dataset(tmp_path / "cut.npz").rows, steps[-70:])


@pytest.mark.parametrize(
    ("env", "size"),
    [("Pendulum-v1", 75), pytest.param("InvertedPendulum-v5", 1000, marks=pytest.mark.slow)],
)
def test_a_buffer_that_saves_memory_lacks_the_ends(env: str, size: int, tmp_path: Path):
    settings = {"optimize_memory_usage": True, "handle_timeout_termination": False}
    model, [steps] = learnt(env, 110, size=size, **settings)
    with pytest.warns(UserWarning, match="left out"):
        export_buffer(model, tmp_path / "buffer.npz")
    held = steps[-size + 1 :] if size < 110 else steps
    if size < 110:  # it begins with an episode of unknown length
        held = held[next(i for i, step in enumerate(held) if step[4] or step[5]) + 1 :]
    kept = [
        (*step[:5], after[4] or after[5])
        for step, after in zip(held, [*held[1:], held[-1]], strict=True)
        if not (step[4] or step[5])
    ]
    same(read_dataset(tmp_path / "buffer.npz").rows, kept)


@pytest.mark.parametrize("kind", [SAC, TD3])
def test_an_exported_policy_is_the_models(kind, tmp_path: Path):
    model = kind(
        "MlpPolicy", gymnasium.make("Pendulum-v1"), seed=0, policy_kwargs={"net_arch": [8]}
    )
    export_policy(model, tmp_path / "policy.pt")
    obs = np.random.default_rng(0).normal(size=(5, 3)).astype(np.float32)
    found = torch.jit.load(tmp_path / "policy.pt")(torch.from_numpy(obs))
    action = 2 * torch.tanh(found[0]) if kind is SAC else found
    expected = model.predict(obs, deterministic=True)[0]
    np.testing.assert_allclose(action.detach(), expected, atol=1e-5)
