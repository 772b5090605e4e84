"""The numbers of a weight progression by hand, and the study's verdicts."""

import numpy as np
import pytest

from tom.analysis.progression import progression, rank_correlation, same_profile
from tom.analysis.weighing import Weighed
from tom.studies.progression import Condition, Result, checks, finding
from tom.studies.study import Row


def stairs() -> np.ndarray:
    """20 bins of 5 rows: ten of weight 0.2, then 0.8, 0.9, ..., 1.6 and 4; mean 0.76."""
    steps = [0.2] * 10 + [0.8, 0.9, 1.0, 1.1, 1.2, 1.3, 1.4, 1.5, 1.6, 2.4]
    return np.repeat(steps, 5)


def test_a_staircase_by_hand():
    report = progression(stairs(), ordered_from=50)
    mean = (10 * 0.2 + 13.2) / 20
    assert report["random_mean"] == pytest.approx(0.2 / mean)
    assert report["deciles"][0] == pytest.approx(0.8 / mean)
    assert report["last_two"] == pytest.approx((1.6 + 2.4) / 2 / mean)
    assert report["spearman"] == pytest.approx(1)
    assert report["first_rise"] == 1  # 0.8 / 0.76 is above 1
    assert report["rises_before_end"]
    assert report["ess"] == pytest.approx(mean**2 / np.mean(stairs() ** 2))
    assert report["zeros"] == 0


def test_weights_that_rise_at_the_very_end_only():
    weights = np.concatenate([np.full(95, 0.1), np.full(5, 20.0)])
    report = progression(weights, ordered_from=50)
    assert report["first_rise"] == 10
    assert not report["rises_before_end"]


def test_uniform_weights_rise_nowhere_and_correlate_with_nothing():
    report = progression(np.ones(100), ordered_from=50)
    assert report["first_rise"] is None
    assert not report["rises_before_end"]
    assert report["spearman"] == 0
    assert report["random_mean"] == report["last_two"] == 1


def test_the_order_of_tiny_weights_counts_and_rounding_does_not():
    recent = np.repeat(0.01 ** np.arange(10)[::-1], 10)  # down to 1e-18 of the newest
    assert progression(recent, 0)["spearman"] == pytest.approx(1)
    assert progression(np.linspace(1, 1 + 1e-15, 100), 0)["spearman"] == 0


def test_rank_correlation_with_ties_by_hand():
    # Ranks of y: 1.5, 1.5, 3, 4. Covariance with 1..4: 4.5 over sqrt(5 * 4.5).
    y = np.array([2.0, 2.0, 5.0, 9.0])
    assert rank_correlation(np.arange(4), y) == pytest.approx(4.5 / np.sqrt(5 * 4.5))


def test_the_same_profile_whatever_the_scale():
    assert same_profile(stairs(), stairs() ** 2) == pytest.approx(1)
    assert same_profile(stairs(), stairs()[::-1].copy()) < 0


def weighed(learner: str, seed: int, weights: np.ndarray) -> Weighed:
    return Weighed(learner, seed, weights.astype(np.float32), None, {}, (), None)


def rising() -> np.ndarray:
    """A thousand rows: about 0.1, then rising steadily."""
    noise = np.random.default_rng(0).uniform(0.9, 1.1, 1000)
    return np.concatenate([np.full(500, 0.1), np.linspace(0.2, 8, 500) ** 1.5]) * noise


def conditions(own: np.ndarray, turned: np.ndarray, moved: np.ndarray) -> list[Result]:
    recent = np.concatenate([np.zeros(900), np.arange(100.0)])
    at_random = np.random.default_rng(0).permutation(recent)

    def case(condition: Condition, tom: np.ndarray, pmac: np.ndarray) -> Result:
        found = [weighed("tom", seed, tom) for seed in range(3)]
        found += [weighed("pmac", seed, pmac) for seed in range(3)]
        return Result("halfcheetah-s0", "halfcheetah", 500, condition, "exact", tuple(found))

    parts = case("own", own, recent), case("random", turned, recent)
    return [*parts, case("shuffled", moved, at_random)]


def study(own: np.ndarray, turned: np.ndarray, moved: np.ndarray) -> list[Row]:
    return checks(conditions(own, turned, moved))


def test_a_profile_that_follows_the_policy_is_accepted():
    found = study(rising(), rising()[::-1].copy(), 2 * rising())
    judged = {(c["condition"], c["learner"], c["quantity"]): c["met"] for c in found if c["bound"]}
    assert len(judged) == 7
    assert all(judged.values())


def test_one_that_follows_the_position_is_not():
    found = study(rising(), rising(), np.random.default_rng(1).permutation(rising()))
    missed = {(c["condition"], c["learner"]) for c in found if c["met"] is False}
    assert missed == {("random", "tom"), ("shuffled", "tom")}


def test_the_median_over_seeds_is_judged():
    case = conditions(rising(), rising(), rising())[0]
    found = finding(case, "tom", "random half", [0.2, 0.9, 0.25], ("<=", 0.3))
    assert (found["median"], found["met"]) == (0.25, True)
    assert finding(case, "tom", "ESS", [0.2])["met"] is None
