"""Means, bands and what is said about missing runs."""

import numpy as np
import pandas as pd
import pytest

from tom.analysis.curves import (
    Curve,
    aggregate,
    groups,
    points_against,
    smoothed,
)


def curve(value: list[float], step: list[int] | None = None, seed: int = 0, learner="tom") -> Curve:
    steps = np.array(step or range(len(value)), np.int64)
    return Curve(f"{learner}-{seed}", "hopper", learner, "paper", seed, steps, np.array(value))


def test_mean_over_seeds() -> None:
    group = aggregate([curve([0, 2, 4]), curve([2, 4, 12], seed=1)])
    assert group.mean.tolist() == [1, 3, 8]
    assert group.count.tolist() == [2, 2, 2]
    assert not group.interpolated
    # Two runs: a resample is (a, a), (a, b), (b, a) or (b, b), so 95 % reaches both.
    assert group.low.tolist() == [0, 2, 4]
    assert group.high.tolist() == [2, 4, 12]


def test_where_a_run_is_missing_there_is_a_mean_of_the_others_and_no_band() -> None:
    group = aggregate([curve([0, 2]), curve([4, 6, 9], seed=1)])
    assert group.mean.tolist() == [2, 4, 9]
    assert group.count.tolist() == [2, 2, 1]
    assert group.complete.tolist() == [True, True, False]
    assert np.isnan(group.low[2])
    assert not group.interpolated


def test_other_steps_are_interpolated_and_that_is_known() -> None:
    group = aggregate([curve([0, 10], [0, 100]), curve([0, 2, 10], [0, 50, 100], seed=1)])
    assert group.step.tolist() == [0, 50, 100]
    assert group.mean.tolist() == [0, (5 + 2) / 2, 10]
    assert group.interpolated


def test_groups_differ_in_everything_but_the_seed() -> None:
    curves = [curve([1], seed=1), curve([2], learner="mle"), curve([3]), curve([])]
    found = groups(curves)
    assert [(g.learner, [c.seed for c in g.curves]) for g in found] == [
        ("mle", [0]),
        ("tom", [0, 1]),
    ]


def test_median_and_iqm_and_the_band_of_one_deviation() -> None:
    curves = [curve([value], seed=i) for i, value in enumerate([0.0, 1, 2, 3, 100])]
    assert aggregate(curves, "median").mean.tolist() == [2]
    assert aggregate(curves, "iqm").mean.tolist() == [2]
    plain = aggregate(curves[:2], "mean", "deviation")
    assert plain.low[0] == pytest.approx(0.5 - np.sqrt(0.5))
    assert plain.high[0] == pytest.approx(0.5 + np.sqrt(0.5))
    assert np.isnan(aggregate(curves, "mean", "none").low).all()


def test_a_missing_run_does_not_count_in_the_median() -> None:
    group = aggregate([curve([1, 1]), curve([3], seed=1), curve([5, 9], seed=2)], "median")
    assert group.mean.tolist() == [3, 5]


def test_smoothing_comes_after_the_runs_are_put_together() -> None:
    group = aggregate([curve([0, 3, 6, 9]), curve([0, 3, 0, 3], seed=1)])
    smooth = smoothed(group, 3)
    assert smooth.mean.tolist() == pytest.approx([1.5, 2, 4, 4.5])
    assert smooth.curves == group.curves
    assert smoothed(group, 1) is group


def test_smoothing_does_not_cross_the_step_where_a_run_ends() -> None:
    smooth = smoothed(aggregate([curve([0, 0, 0]), curve([8, 8, 8, 8, 6], seed=1)]), 3)
    assert smooth.mean.tolist() == [4, 4, 4, 7, 7]
    assert smooth.high.tolist()[:3] == [8, 8, 8]
    assert np.isnan(smooth.high[3:]).all()


def test_interpolation_is_known_where_the_group_is_thinned_too() -> None:
    even, odd = list(range(0, 6000, 2)), list(range(1, 6000, 2))
    group = aggregate([curve([1.0] * 3000, even), curve([1.0] * 3000, odd, seed=1)])
    assert group.thinned
    assert group.interpolated
    assert not aggregate([curve([1.0] * 3000, even), curve([1.0] * 3000, even)]).interpolated


def test_any_metric_may_be_the_x_axis() -> None:
    frame = pd.DataFrame(
        {
            "env_step": [0, 10, 20, 30],
            "eval/return": [np.nan, 5.0, np.nan, 7.0],
            "weights/ess": [1.0, np.nan, 0.5, np.nan],
        }
    )
    x, value = points_against(frame, "eval/return", "weights/ess")
    assert x.tolist() == [0.75]  # at step 30 nothing is known of the other any more
    assert value.tolist() == [5]
