import torch

from tom.data.episodes import episode_numbers, held_out_rows
from tom.data.transitions import TensorTransitions


def rows(n: int, terminated: list[int], truncated: list[int]) -> TensorTransitions:
    ends, limits = torch.zeros(n), torch.zeros(n)
    ends[terminated], limits[truncated] = 1.0, 1.0
    return TensorTransitions(
        torch.rand(n, 2), torch.rand(n, 1), ends, torch.rand(n, 2), ends, limits
    )


def generator() -> torch.Generator:
    return torch.Generator().manual_seed(0)


def test_an_end_of_either_kind_begins_a_new_episode():
    assert episode_numbers(rows(6, [1], [4])).tolist() == [0, 0, 1, 1, 1, 2]


def test_whole_episodes_are_held_out_until_the_share_is_reached():
    buffer = rows(1000, list(range(9, 1000, 10)), [])
    held_out = held_out_rows(buffer, 0.25, generator())
    per_episode = held_out.view(100, 10).float().mean(1)
    assert set(per_episode.tolist()) == {0.0, 1.0}
    assert int(held_out.sum()) == 250


def test_an_episode_is_always_left_to_train_on():
    buffer = rows(1000, [*range(0, 9), 999], [])
    for seed in range(40):  # with some the long episode is the last of all in the order drawn
        held_out = held_out_rows(buffer, 0.5, torch.Generator().manual_seed(seed))
        assert 0 < int(held_out.sum()) < 1000
    assert held_out_rows(rows(1, [], []), 0.5, generator()).tolist() == [False]


def test_rows_of_one_long_episode_are_held_out_in_blocks():
    held_out = held_out_rows(rows(2000, [], []), 0.2, generator())
    assert set(held_out.view(20, 100).float().mean(1).tolist()) == {0.0, 1.0}
    assert int(held_out.sum()) == 400
