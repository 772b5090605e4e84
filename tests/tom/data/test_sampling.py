"""Weighted sampling: frequencies, degenerate weights, profiles."""

import numpy as np
import pytest
import torch
from scipy.stats import chisquare

from tom.data.sampling import (
    WeightedSampler,
    bin_means,
    ess,
    normalise,
    uniform_indices,
    zero_share,
)


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def test_frequencies_follow_the_weights():
    weights = torch.tensor([0.0, 3.0, 1.0, 0.0, 0.5, 5.5, 0.0])
    n = 200_000
    counts = torch.bincount(WeightedSampler(weights, generator()).draw(n), minlength=7)
    assert counts[weights == 0].sum() == 0
    kept = weights > 0
    expected = weights[kept].double() / weights.double().sum() * n
    assert chisquare(counts[kept].numpy(), expected.numpy()).pvalue > 1e-3


def test_more_rows_than_multinomial_can_take():
    weights = torch.zeros(2**24 + 10)
    weights[-1] = 2.0
    weights[5] = 1.0
    drawn = WeightedSampler(weights, generator()).draw(3000)
    assert set(drawn.tolist()) == {5, 2**24 + 9}
    assert abs((drawn == 5).double().mean() - 1 / 3) < 0.05


def test_draws_repeat_with_the_seed():
    weights = torch.rand(100, generator=generator(1))
    first, second = (WeightedSampler(weights, generator(7)).draw(50) for _ in range(2))
    assert torch.equal(first, second)


@pytest.mark.parametrize("bad", [0.0, float("nan"), float("inf"), -1.0])
def test_degenerate_weights_become_uniform_and_are_reported(bad):
    weights = torch.full((4,), bad)
    assert normalise(weights)[1]
    assert normalise(weights)[0].tolist() == [1.0] * 4
    with pytest.raises(ValueError, match="not all zero"):
        WeightedSampler(weights, generator())


def test_one_bad_weight_among_good_ones_is_degenerate():
    for bad in (float("nan"), float("inf"), -1e-3):
        weights, degenerate = normalise(torch.tensor([1.0, bad, 2.0]))
        assert degenerate
        assert weights.tolist() == [1.0, 1.0, 1.0]


def test_normalised_weights_have_mean_one_and_keep_their_ratios():
    weights, degenerate = normalise(torch.tensor([0.0, 1.0, 3.0, 0.0]))
    assert not degenerate
    assert weights.tolist() == [0.0, 1.0, 3.0, 0.0]
    tiny, degenerate = normalise(torch.tensor([1e-30, 3e-30]))
    assert not degenerate
    torch.testing.assert_close(tiny, torch.tensor([0.5, 1.5]))


def test_uniform_indices_cover_the_range_evenly():
    counts = torch.bincount(uniform_indices(10, 100_000, generator()), minlength=10)
    assert chisquare(counts.numpy()).pvalue > 1e-3


def test_effective_sample_size():
    assert ess(torch.ones(50)) == 1.0
    assert ess(torch.tensor([0.0, 0.0, 7.0, 0.0])) == 0.25
    assert ess(torch.zeros(3)) == 0.0


def test_bins_are_means_of_equal_parts():
    weights = torch.arange(12, dtype=torch.float32)
    assert bin_means(weights, 4).tolist() == [1.0, 4.0, 7.0, 10.0]
    assert bin_means(weights.numpy(), 1).tolist() == [5.5]


@pytest.mark.parametrize("n", [1, 3, 99, 100, 101, 1234])
def test_bins_keep_the_mean_for_any_length(n):
    weights = torch.rand(n, generator=generator(n))
    means = bin_means(weights, 100)
    assert means.shape == (100,)
    torch.testing.assert_close(means.mean(), weights.double().mean())


def test_fewer_rows_than_bins_spread_over_several():
    assert bin_means(torch.tensor([1.0, 3.0]), 4).tolist() == [1.0, 1.0, 3.0, 3.0]
    assert bin_means(torch.tensor([1.0, 3.0]), 3).tolist() == pytest.approx([1.0, 2.0, 3.0])


def test_the_share_of_zeros_counts_rows():
    assert zero_share(np.array([0.0, 0.0, 1.0, 2.0])) == 0.5
    assert zero_share(np.zeros(0)) == 0.0
