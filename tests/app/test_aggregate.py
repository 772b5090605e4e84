"""Means, bands and what is said about missing runs."""

import numpy as np
import pandas as pd
import pytest
from hypothesis import given
from hypothesis import strategies as st

from app.aggregate import (
    Curve,
    aggregate,
    bootstrap_band,
    curve_points,
    decimate,
    groups,
    interval,
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


def test_one_run_has_no_band() -> None:
    group = aggregate([curve([1, 2])])
    assert np.isnan(group.low).all()
    assert np.isnan(group.high).all()
    assert group.mean.tolist() == [1, 2]


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


def test_band_is_the_percentile_bootstrap() -> None:
    values = np.random.default_rng(1).normal(size=(6, 1))
    low, high = bootstrap_band(values, resamples=20_000)
    draws = np.random.default_rng(2).choice(values[:, 0], (20_000, 6)).mean(1)
    assert low[0] == pytest.approx(np.quantile(draws, 0.025), abs=0.03)
    assert high[0] == pytest.approx(np.quantile(draws, 0.975), abs=0.03)


def test_band_is_the_same_at_every_call() -> None:
    values = np.random.default_rng(1).normal(size=(4, 9))
    assert np.array_equal(bootstrap_band(values), bootstrap_band(values))


def test_interval_of_one_number_has_no_bounds() -> None:
    mean, low, high = interval(np.array([3.0]))
    assert mean == 3
    assert np.isnan([low, high]).all()


def test_points_are_those_that_were_recorded() -> None:
    frame = pd.DataFrame({"env_step": [0, 5, 9], "eval/return": [1.0, np.nan, 3.0]})
    step, value = curve_points(frame, "eval/return")
    assert step.tolist() == [0, 9]
    assert value.tolist() == [1, 3]
    assert len(curve_points(frame, "no/such")[0]) == 0


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
