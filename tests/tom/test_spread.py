"""Some of many things, evenly."""

import numpy as np
import pytest

from tom.spread import spread


@pytest.mark.parametrize("most", [1, 2, 7, 99, 100, 101])
@pytest.mark.parametrize("count", [1, 2, 3, 100, 12_345])
def test_rows_are_even_and_each_is_taken_once(count: int, most: int) -> None:
    rows = spread(count, most)
    assert len(rows) == min(count, most)
    assert rows[0] == 0
    if len(rows) > 1:
        assert rows[-1] == count - 1
        gaps = np.diff(rows)
        assert gaps.min() >= 1
        assert np.ptp(gaps) <= 1


def test_of_nothing_there_is_nothing() -> None:
    assert len(spread(0, 5)) == 0
