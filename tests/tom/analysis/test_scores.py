"""One number a run, and what the numbers of several come to."""

import numpy as np
import pytest

from tom.analysis.curves import Curve
from tom.analysis.scores import (
    HEIGHT,
    all_have_started,
    common_start,
    common_step,
    interval,
    scores_of,
    steps_to,
)


def curve(step: list[int], value: list[float]) -> Curve:
    return Curve("a", "ant", "tom", "paper", 0, np.array(step), np.array(value))


def test_the_common_step_is_where_the_first_run_ends() -> None:
    short, long = curve([1, 5], [0, 0]), curve([6, 9], [0, 0])
    assert common_step([short, long]) == 5
    assert all_have_started([short], 5)
    assert not all_have_started([short, long], 5)


def test_mean_heights_begin_where_every_run_has_begun() -> None:
    """Else the run that was first evaluated later stands higher, for the same returns."""
    often, seldom = curve([1, 2, 3, 4], [1, 2, 3, 4]), curve([2, 4], [2, 4])
    assert common_start([often, seldom]) == 2
    assert scores_of([often, seldom], HEIGHT, 4).tolist() == [2.5, 3]
    assert scores_of([often, seldom], HEIGHT, 4, since=2).tolist() == [3, 3]
    assert scores_of([often, seldom], HEIGHT, 2, since=2).tolist() == [2, 2]  # a single point


def test_a_curve_that_ends_earlier_has_no_mean_height() -> None:
    """It is not extrapolated; only where there is no width to take a mean over one value stands."""
    short, single, none = curve([1, 3], [1, 3]), curve([1], [5]), curve([], [])
    assert np.isnan(scores_of([short, single, none], HEIGHT, 4)).all()
    assert np.isnan(scores_of([short], HEIGHT, 4, since=4)).all()
    assert scores_of([short, single], HEIGHT, 1).tolist() == [1, 5]
    assert np.isnan(scores_of([short], HEIGHT, 0)).all()
    assert np.isnan(scores_of([curve([1, 2, 3], [1, np.nan, 3])], HEIGHT, 3)).all()


def test_a_mean_height_is_the_area_over_the_width() -> None:
    rising = curve([0, 10], [0, 1])
    assert scores_of([rising, curve([0, 10, 20], [0, 1, 9])], HEIGHT, 10).tolist() == [0.5, 0.5]
    assert scores_of([curve([0, 20], [0, 2])], HEIGHT, 10).tolist() == [0.5]
    assert scores_of([curve([0, 20], [0, 2])], HEIGHT, 20, since=10).tolist() == [1.5]
    assert scores_of([curve([5, 15], [1, 3])], HEIGHT, 15, since=0).tolist() == [2]


def test_a_run_that_gets_there_later_does_not_get_there() -> None:
    curves = [curve([1, 2, 3], [0, 1, 2]), curve([1, 2, 3], [2, 0, 0])]
    assert steps_to(curves, 2.0, until=2).tolist() == [np.inf, 1]
    assert steps_to(curves, 2.0, until=3).tolist() == [3, 1]


@pytest.mark.parametrize("values", [[], [1.0, np.nan]])
def test_without_every_run_there_is_no_statistic_of_them(values: list[float]) -> None:
    assert np.isnan(interval(np.array(values), "iqm").value)
