"""Evaluation: whole episodes, reproducible, apart from the training environment."""

from dataclasses import replace

import numpy as np
import torch

from tom.envs import ENVS
from tom.policy.collect import Evaluator


def test_episodes_are_complete_and_consistent():
    task = ENVS["hopper"]
    widths = []

    def policy(obs):
        widths.append(len(obs))
        return torch.sin(7 * obs[:, :3])

    episodes = Evaluator(task, 4).run(policy, seed=1)
    assert len(episodes) == 4
    assert widths[0] == 4
    assert widths == sorted(widths, reverse=True)
    assert len(widths) == max(e.length for e in episodes)
    assert sum(widths) == sum(e.length for e in episodes)
    for e in episodes:
        h = e.length
        assert e.terminated
        assert not e.truncated
        assert e.obs.shape == (h + 1, 11)
        assert e.action.shape == (h, 3)
        assert e.qpos is not None
        assert e.qvel is not None
        assert e.qpos.shape == e.qvel.shape == (h + 1, 6)
        assert {a.dtype for a in (e.obs, e.action, e.reward, e.qpos, e.qvel)} == {
            np.dtype(np.float32)
        }
        np.testing.assert_array_equal(e.obs[:, :5], e.qpos[:, 1:])
        np.testing.assert_array_equal(task.qpos_from_obs(e.obs)[:, 1:], e.qpos[:, 1:])
        np.testing.assert_allclose(e.action, np.sin(7 * e.obs[:-1, :3]), atol=1e-6)
        ends = task.terminated(torch.from_numpy(e.obs[1:]))
        assert ends.tolist() == [False] * (h - 1) + [True]


def test_replaying_the_actions_in_one_environment_gives_the_recorded_episode():
    """Batching and reuse of environments change nothing: one env, one action at a time."""
    task = ENVS["walker2d"]
    evaluator = Evaluator(task, 2)
    for seed in (4, 5):
        recorded = evaluator.run(lambda obs: torch.tanh(obs[:, :6]), seed)
        starts = np.random.SeedSequence(seed).generate_state(2)
        for e, start in zip(recorded, starts, strict=True):
            env = task.make()
            obs, _ = env.reset(seed=int(start))
            np.testing.assert_array_equal(obs.astype(np.float32), e.obs[0])
            for t in range(e.length):
                obs, reward, *ended, _ = env.step(e.action[t])
                np.testing.assert_array_equal(obs.astype(np.float32), e.obs[t + 1])
                assert np.float32(reward) == e.reward[t]
                last = t == e.length - 1
                assert ended == [last and e.terminated, last and e.truncated]


def test_the_time_limit_is_the_tasks_own_and_truncates():
    task = replace(ENVS["halfcheetah"], max_episode_steps=37)
    (episode,) = Evaluator(task, 1).run(lambda obs: torch.zeros(len(obs), 6), seed=0)
    assert episode.length == 37
    assert episode.truncated
    assert not episode.terminated
