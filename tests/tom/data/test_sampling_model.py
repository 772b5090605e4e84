"""The weighted sampler against the plainest inverse of a distribution function."""

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from tom.data.sampling import WeightedSampler, normalise

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


def check(weights: list[float], n: int, seed: int) -> None:
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


@settings(max_examples=60, deadline=None)
@given(weights=WEIGHTS, n=st.integers(0, 50), seed=st.integers(0, 2**31))
def test_draws_are_the_plain_ones(weights: list[float], n: int, seed: int):
    check(weights, n, seed)


@pytest.mark.fault
@settings(max_examples=2000, deadline=None)
@given(weights=WEIGHTS, n=st.integers(0, 50), seed=st.integers(0, 2**31))
def test_any_weights__draw_the_plain_rows_and_never_one_of_weight_zero(
    weights: list[float], n: int, seed: int
):
    check(weights, n, seed)
