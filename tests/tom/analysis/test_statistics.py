"""Against numbers worked out by hand, scipy, and the formulae that rliable publishes."""

import itertools
import math

import numpy as np
import pytest
from scipy import stats

from tom.analysis import statistics as st

# Four seeds of two tasks; the second task is on a tenth of the first one's scale.
SCORES = np.array([[1.0, 0.1], [2.0, 0.2], [3.0, 0.3], [10.0, 0.4]])


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def value(scores: np.ndarray, statistic: st.Statistic) -> float:
    return st.interval(scores.T, statistic).value


def test_aggregates_by_hand():
    assert value(SCORES, st.mean) == pytest.approx((4.0 + 0.25) / 2)
    assert value(SCORES, st.median) == pytest.approx((4.0 + 0.25) / 2)  # of two task means
    # Sorted .1 .2 .3 .4 1 2 3 10: two are cut from either end.
    assert value(SCORES, st.iqm) == pytest.approx((0.3 + 0.4 + 1 + 2) / 4)


def test_three_tasks_have_the_median_of_their_means():
    scores = np.array([[0.0, 5.0, 9.0], [2.0, 5.0, 90.0]])
    assert value(scores, st.median) == 5.0
    assert value(SCORES[:, :1], st.median) == 2.5  # of one task that of its runs


def test_missing_runs_leave_the_others_in_place():
    scores = np.array([[1.0, 4.0], [3.0, np.nan], [5.0, 6.0]])
    assert value(scores, st.mean) == pytest.approx((3 + 5) / 2)


def test_the_bootstrap_is_stratified():
    """Runs that differ between tasks only leave no spread: no task borrows another's run."""
    scores = np.array([[1.0, 100.0], [1.0, 100.0], [1.0, 100.0]])
    found = st.interval(scores.T, st.mean)
    assert (found.value, found.low, found.high) == (50.5, 50.5, 50.5)


def test_the_interval_is_the_percentile_interval():
    scores = rng(1).normal(size=(12, 3))
    draws = rng(2).integers(0, 12, size=(20_000, 12, 3))
    means = np.take_along_axis(scores[None], draws, axis=1).mean((1, 2))
    low, high = np.quantile(means, [0.025, 0.975])
    found = st.interval(scores.T, st.mean, resamples=20_000)
    assert found.low == pytest.approx(low, abs=0.01)
    assert found.high == pytest.approx(high, abs=0.01)


def test_one_run_has_no_interval():
    found = st.interval([[3.0], [5.0]], st.iqm)
    assert found.value == 4.0
    assert np.isnan([found.low, found.high]).all()
    assert str(found) == "4"


def test_a_band_is_the_interval_at_every_point():
    curves = rng(4).normal(size=(6, 9))
    low, high = st.band(curves, st.iqm)
    for t in range(9):
        point = st.interval([curves[:, t]], st.iqm)
        assert (low[t], high[t]) == pytest.approx((point.low, point.high))


@pytest.mark.parametrize("n", [3, 5, 8])
def test_few_seeds_hold_the_truth_as_seldom_as_the_remark_says(n: int):
    low, high = st.band(rng(5).normal(size=(n, 4000)), st.mean, resamples=500)
    held = 100 * float(((low <= 0) & (high >= 0)).mean())
    assert held == pytest.approx(st.COVERAGE[n], abs=3)
    assert f"{st.COVERAGE[n]} of 100" in st.remark(n)


def test_performance_profile_by_hand():
    found = st.performance_profile(SCORES.T, [0.0, 0.25, 2.0, 10.0])
    # Above .25: all of task one, half of task two; above 2: half and none.
    assert found == pytest.approx([1.0, 0.75, 0.25, 0.0])


def test_profile_band_holds_the_profile():
    scores = rng(6).normal(size=(8, 3))
    at = np.linspace(-2, 2, 7)
    low, high = st.profile_band(scores.T, at)
    profile = st.performance_profile(scores.T, at)
    assert (low <= profile).all()
    assert (profile <= high).all()
    assert np.isnan(st.profile_band(scores.T[:, :1], at)).all()


def test_profile_band_of_few_runs_falls_as_its_profile_does():
    # 1 resample of 27 lacks the two higher runs: near the 2.5 % where the band ends.
    low, high = st.profile_band([[0.0, 1.0, 1.0]], np.linspace(-1, 2, 61), 300)
    assert (np.diff(low) <= 0).all()
    assert (np.diff(high) <= 0).all()


def test_probability_of_improvement_is_mann_and_whitney_s():
    x, y = rng(7).integers(0, 6, size=(2, 9, 4)).astype(float)  # integers: ties
    expected = [
        stats.mannwhitneyu(a, b, alternative="greater").statistic / 81
        for a, b in zip(x.T, y.T, strict=True)
    ]
    found = st.probability_of_improvement(x.T, y.T)
    assert found.value == pytest.approx(np.mean(expected))
    assert found.low < found.value < found.high
    other = st.probability_of_improvement(y.T, x.T)
    assert found.value + other.value == pytest.approx(1)


def test_improvement_by_hand_with_other_numbers_of_runs():
    found = st.probability_of_improvement([[1.0, 2.0, 3.0]], [[2.0, 0.0]])
    assert found.value == pytest.approx((1 + 1.5 + 2) / 6)
    assert np.isnan(st.probability_of_improvement([[1.0]], [[2.0, 0.0]]).low)


@pytest.mark.parametrize(("n", "m"), [(1, 1), (2, 2), (5, 5), (6, 3), (12, 9)])
def test_the_p_of_an_improvement_is_exact_for_one_task(n: int, m: int):
    x, y = rng(3).normal(size=(1, n)) + 1, rng(4).normal(size=(1, m))
    exact = stats.mannwhitneyu(x[0], y[0], method="exact").pvalue
    assert st.exchangeable(x, y) == pytest.approx(exact, abs=1e-12)
    assert st.exchangeable(y, x) == pytest.approx(exact, abs=1e-12)
    assert st.exchangeable(x + 99, y) == pytest.approx(2 / math.comb(n + m, n), abs=1e-12)
    assert st.exchangeable(np.ones((1, n)), np.ones((1, m))) == 1  # ties alone


def test_the_p_with_ties_and_several_tasks_counts_all_arrangements():
    draws = rng(9)
    x, y = draws.integers(0, 4, size=(3, 2)).astype(float), draws.integers(0, 4, size=(2, 2)) + 1.0
    x = np.vstack([x, [2.0, np.nan]])  # four runs of the first task, three of the second

    def every(a: np.ndarray, b: np.ndarray) -> list[float]:
        """P(a run beats one of the others) in each arrangement, pair by pair."""
        runs = [*a[~np.isnan(a)], *b]
        n = len(runs) - len(b)
        found = []
        for chosen in itertools.combinations(range(len(runs)), n):
            rest = [runs[j] for j in range(len(runs)) if j not in chosen]
            pairs = [(runs[i] > r) + (runs[i] == r) / 2 for i in chosen for r in rest]
            found.append(float(np.mean(pairs)))
        return found  # the first one is the observed one

    first, second = every(x[:, 0], y[:, 0]), every(x[:, 1], y[:, 1])
    gaps = np.abs((np.array(first)[:, None] + second) / 2 - 0.5)
    assert st.exchangeable(x.T, y.T) == pytest.approx(np.mean(gaps >= gaps[0, 0] - 1e-9), abs=1e-12)


def test_tasks_add_up_in_the_p_of_an_improvement():
    more, less = [3.0, 4.0, 5.0], [0.0, 1.0, 2.0]
    assert st.exchangeable([more], [less]) == pytest.approx(2 / 20)
    assert st.exchangeable([more, more], [less, less]) == pytest.approx(2 / 400)
    assert st.exchangeable([more, less], [less, more]) == 1


def test_the_p_of_several_tests_are_corrected_as_holm_says():
    # Holm 1979: the smallest times the number of tests, the next times one fewer, never falling.
    assert st.corrected([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert st.corrected([0.5, 0.9]) == [1, 1]
    assert st.corrected([0.02]) == [0.02]
    assert st.corrected([]) == []
