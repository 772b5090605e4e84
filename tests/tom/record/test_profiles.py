import numpy as np

from tom.record.profiles import zero_share


def test_the_share_of_zeros_counts_rows():
    assert zero_share(np.array([0.0, 0.0, 1.0, 2.0])) == 0.5
    assert zero_share(np.zeros(0)) == 0.0
