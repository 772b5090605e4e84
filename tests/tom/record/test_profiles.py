import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from tom.record.profiles import effective_share, profile, zero_share


def test_a_bin_is_the_mean_of_its_part_oldest_first():
    np.testing.assert_allclose(profile(np.arange(200), 100), np.arange(100) * 2 + 0.5)


@settings(deadline=None)
@given(st.integers(0, 400), st.integers(1, 120))
def test_bins_cover_every_transition_once(count: int, bins: int):
    weight = np.random.default_rng(count).random(count)
    slow = [weight[b * count // bins : (b + 1) * count // bins] for b in range(bins)]
    means = profile(weight, bins)
    assert sum(map(len, slow)) == count
    for got, part in zip(means, slow, strict=True):
        assert np.isnan(got) if not len(part) else np.isclose(got, part.mean())


def test_effective_share_is_one_for_equal_weights_and_one_nth_for_a_single_one():
    assert effective_share(np.full(50, 3.0)) == 1.0
    assert effective_share(np.eye(50)[7]) == 1 / 50
    assert effective_share(np.zeros(50)) == 0.0
    assert zero_share(np.array([0.0, 0.0, 1.0, 2.0])) == 0.5
