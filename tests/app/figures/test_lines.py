"""Thinned lines keep their extremes."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from app.figures.base import decimate


@settings(deadline=None)
@given(st.integers(10, 3000), st.integers(4, 200))
def test_thinning_keeps_the_extremes(count: int, limit: int) -> None:
    value = np.random.default_rng(count).normal(size=count)
    step, kept, cut = decimate(np.arange(count), value, limit)
    assert cut == (count > limit)
    assert len(step) <= limit or not cut
    assert kept.max() == value.max()
    assert kept.min() == value.min()
    assert np.array_equal(value[step], kept)
    assert (np.diff(step) > 0).all()
