import numpy as np
import pytest
import torch
from common import generator

from tom.config import RoadConfig
from tom.rng import Streams
from tom.road import offline_data, task


@pytest.fixture(scope="module")
def road_map() -> task.RoadMap:
    return task.draw_map(180.0, 90.0, generator())


def test_walks_are_whole_walks_of_twenty_steps(road_map: task.RoadMap):
    rows = offline_data.random_walks(road_map, 2000, generator())
    assert len(rows) == 2000
    ends = (rows.truncated + rows.terminated).view(100, 20)
    assert (ends[:, -1] == 1).all()
    assert rows.truncated.view(100, 20)[:, :-1].sum() == 0
    within = rows.terminated.view(100, 20)[:, :-1] == 0
    joined = (rows.next_obs.view(100, 20, 2)[:, :-1] == rows.obs.view(100, 20, 2)[:, 1:]).all(-1)
    assert torch.equal(joined, within)  # a walk goes on where it was, but not beyond the goal
    assert rows.terminated.sum() > 0
    assert torch.equal(rows.terminated.bool(), task.at_goal(rows.next_obs))
    torch.testing.assert_close(rows.reward, task.reward(rows.next_obs))


def test_walks_cover_the_map_and_the_actions(road_map: task.RoadMap):
    rows = offline_data.random_walks(road_map, 10_000, generator())
    counts, _, _ = np.histogram2d(*rows.obs.T.numpy(), bins=5, range=[[0, 1], [0, 1]])
    assert counts.min() > 100
    assert rows.action.mean(0).abs().max() < 0.03
    assert rows.action.square().mean(0).tolist() == pytest.approx([1 / 3, 1 / 3], abs=0.02)


def test_the_expert_succeeds_and_random_steering_does_not(road_map: task.RoadMap):
    expert = offline_data.drive(road_map, offline_data.noisy_expert(generator()), 50, generator())
    chance = offline_data.drive(
        road_map, offline_data.random_steering(generator()), 50, generator()
    )
    assert all(e.info["success"] == 1 and e.terminated for e in expert)
    assert not any(e.info["success"] for e in chance)
    assert all(e.truncated and e.length == 80 for e in chance)
    assert 36 <= np.mean([e.length for e in expert]) <= 44
    assert np.mean([e.undiscounted_return for e in expert]) == pytest.approx(-22, abs=2)
    assert np.mean([e.undiscounted_return for e in chance]) < -110


def test_an_episode_ends_on_arrival(road_map: task.RoadMap):
    episode = offline_data.drive(road_map, task.expert_action, 1, generator())[0]
    arrived = task.at_goal(torch.from_numpy(episode.obs))
    assert arrived[-1]
    assert not arrived[:-1].any()
    rows = offline_data.episode_rows(episode)
    assert len(rows) == episode.length == len(episode.obs) - 1
    assert rows.terminated.tolist() == [0.0] * (len(rows) - 1) + [1.0]
    assert rows.truncated.sum() == 0
    torch.testing.assert_close(rows.reward.sum().item(), episode.undiscounted_return)


@pytest.mark.parametrize("first", [False, True])
def test_expert_rows_and_footprint_are_where_they_are_said_to_be(first: bool):
    config = RoadConfig(
        learner="mle", random_transitions=200, expert_trajectories=3, expert_first=first
    )
    data = offline_data.collect(config, Streams(0))
    shown = torch.cat([torch.from_numpy(e.obs[:-1]) for e in data.demonstrations])
    assert torch.equal(data.rows.obs[data.expert], shown)
    footprint = data.rows.obs[data.footprint]
    assert torch.equal(footprint, torch.from_numpy(data.demonstrations[0].obs[:-1]))
    assert bool(data.expert[0]) is first
    assert int((~data.expert).sum()) == 200


def test_the_map_is_the_runs_own_unless_configured():
    def gain(seed: int, map_seed: int | None) -> torch.Tensor:
        config = RoadConfig(
            learner="mle",
            seed=seed,
            map_seed=map_seed,
            random_transitions=20,
            expert_trajectories=1,
        )
        return offline_data.collect(config, Streams(seed)).road_map.gain

    assert torch.equal(gain(3, None), gain(4, 3))
    assert not torch.equal(gain(3, None), gain(4, None))
