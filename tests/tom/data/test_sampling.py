"""Weighted sampling against its plainest form; held-out episodes; degenerate weights; profiles."""

import numpy as np
import pytest
import torch
from common import generator
from hypothesis import given, settings
from hypothesis import strategies as st

from tom.data.sampling import (
    WeightedSampler,
    bin_means,
    episode_numbers,
    ess,
    held_out_rows,
    normalise,
    zero_share,
)
from tom.data.transitions import TensorTransitions

WEIGHTS = st.lists(
    st.one_of(st.just(0.0), st.floats(2.0**-20, 2.0**20, width=32)), min_size=1, max_size=40
)


def plain_draws(weights: list[float], n: int, seed: int) -> list[int]:
    """The row whose share of [0, 1) a uniform number falls into, one after the other."""
    uniform = torch.rand(n, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    ends, total = [], 0.0
    for weight in weights:
        total += weight
        ends.append(total)
    last = max(i for i, weight in enumerate(weights) if weight > 0)
    return [next((i for i, e in enumerate(ends) if u * total < e), last) for u in uniform.tolist()]


@settings(max_examples=60, deadline=None)
@given(weights=WEIGHTS, n=st.integers(0, 50), seed=st.integers(0, 2**31))
def test_draws_are_the_plain_ones(weights: list[float], n: int, seed: int):
    tensor = torch.tensor(weights)
    scaled, degenerate = normalise(tensor)
    assert degenerate == (sum(weights) == 0)
    assert float(scaled.mean()) == pytest.approx(1.0, rel=1e-4)
    generator = torch.Generator().manual_seed(seed)
    if degenerate:
        with pytest.raises(ValueError, match="not all zero"):
            WeightedSampler(tensor, generator)
        return
    drawn = WeightedSampler(tensor, generator).draw(n).tolist()
    assert drawn == plain_draws(tensor.double().tolist(), n, seed)
    assert all(weights[row] > 0 for row in drawn)


def test_more_rows_than_multinomial_can_take():
    weights = torch.zeros(2**24 + 10)
    weights[-1] = 2.0
    weights[5] = 1.0
    drawn = WeightedSampler(weights, generator()).draw(3000)
    assert set(drawn.tolist()) == {5, 2**24 + 9}
    assert abs((drawn == 5).double().mean() - 1 / 3) < 0.05


@pytest.mark.parametrize("first", [0.0, 1.0])
@pytest.mark.parametrize("bad", [float("nan"), float("inf"), -1e-3])
def test_degenerate_weights_become_uniform_and_are_reported(first: float, bad: float):
    weights = torch.tensor([first, bad])
    assert normalise(weights)[1]
    assert normalise(weights)[0].tolist() == [1.0, 1.0]
    with pytest.raises(ValueError, match="not all zero"):
        WeightedSampler(weights, generator())


def test_effective_sample_size_and_the_share_of_zeros():
    assert zero_share(np.array([0.0, 0.0, 1.0, 2.0])) == 0.5
    assert zero_share(np.zeros(0)) == 0.0
    assert ess(torch.ones(50)) == 1.0
    assert ess(torch.tensor([0.0, 0.0, 7.0, 0.0])) == 0.25
    assert ess(torch.zeros(3)) == 0.0


def test_bins_are_means_of_equal_parts():
    weights = torch.arange(12, dtype=torch.float32)
    assert bin_means(weights, 4).tolist() == [1.0, 4.0, 7.0, 10.0]
    assert bin_means(weights.numpy(), 1).tolist() == [5.5]


@pytest.mark.parametrize("n", [1, 99, 100, 1234])
def test_bins_keep_the_mean_for_any_length(n):
    weights = torch.rand(n, generator=generator(n))
    means = bin_means(weights, 100)
    assert means.shape == (100,)
    torch.testing.assert_close(means.mean(), weights.double().mean())


def test_fewer_rows_than_bins_spread_over_several():
    assert bin_means(torch.tensor([1.0, 3.0]), 4).tolist() == [1.0, 1.0, 3.0, 3.0]
    assert bin_means(torch.tensor([1.0, 3.0]), 3).tolist() == pytest.approx([1.0, 2.0, 3.0])


def rows(n: int, terminated: list[int], truncated: list[int]) -> TensorTransitions:
    ends, limits = torch.zeros(n), torch.zeros(n)
    ends[terminated], limits[truncated] = 1.0, 1.0
    return TensorTransitions(
        torch.rand(n, 2), torch.rand(n, 1), ends, torch.rand(n, 2), ends, limits
    )


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
