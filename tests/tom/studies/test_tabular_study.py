from dataclasses import replace

import numpy as np
import pytest

from tom.studies.tabular import (
    VARIANTS,
    Case,
    Variant,
    cases,
    estimate,
    model_bias,
    summary,
)

QUICK = {
    "q_hidden": 32,
    "discriminator_hidden": 32,
    "q_steps": 60,
    "discriminator_steps": 60,
    "parameter_average": 0.9,
}
SMALL = Case(0, 2, 0.9, "chi2", states=4, actions=2, replay=2000, policy_buffer=500, starts=200)


def test_cases_are_the_full_grid_for_each_seed():
    found = cases(range(3))
    assert len(found) == len(set(found)) == 24
    assert {c.successors for c in found} == {1, 3}
    assert {c.discount for c in found} == {0.9, 0.99}
    assert {c.divergence for c in found} == {"chi2", "kl"}


def test_an_estimate_carries_the_points_behind_its_score():
    found = estimate(SMALL, Variant("quick", changes=QUICK, support=True))
    seen = np.isfinite(found.estimated)
    assert found.replay @ found.exact == pytest.approx(1.0)
    assert found.replay[seen] @ found.estimated[seen] == pytest.approx(1.0, abs=0.1)
    assert found.exact.shape == found.estimated.shape == found.replay.shape
    row = found.row()
    assert row["variant"] == "quick"
    assert row["seed"] == 0
    assert {"spearman", "l1", "flow", "log_ratio", "raw_mean"} <= set(row)


def test_only_the_variant_differs_between_rows_of_a_case():
    a, b = (estimate(SMALL, Variant(name, changes=QUICK)) for name in "ab")
    assert a.score == b.score
    c = estimate(SMALL, Variant("c", changes=QUICK, support=True))
    assert (c.exact == a.exact).all()
    assert c.score != a.score


def test_only_chi2_with_stochastic_dynamics_biases_the_model():
    for case in cases(range(3)):
        biased = case.divergence == "chi2" and case.successors > 1
        assert (model_bias(case) > 0.01) is biased


def test_summary_takes_median_and_worst_of_each_variant():
    score = {"l1": 0.1, "flow": 0.1, "log_ratio": 0.9, "raw_mean": 1.0}
    rows = [{"variant": "a", "spearman": s, **score} for s in (0.9, 0.95, 0.99)]
    rows.append({"variant": "b", "spearman": 0.5, **score, "raw_mean": 0.4})
    a, b = summary(rows)
    assert (a["runs"], a["spearman"], a["spearman_worst"]) == (3, 0.95, 0.9)
    assert (b["variant"], b["raw_mean_worst"]) == ("b", 0.4)


@pytest.mark.slow
def test_acceptance_of_the_exact_preset():
    """Eight MDPs under both divergences: what the estimator must reach."""
    rows = [e.row() for e in (estimate(case, VARIANTS[0]) for case in cases(range(2)))]
    (found,) = summary(rows)
    assert found["spearman"] >= 0.95
    assert found["spearman_worst"] >= 0.90
    assert found["l1"] <= 0.12
    assert found["l1_worst"] <= 0.20
    assert found["flow_worst"] <= 0.12
    assert found["log_ratio_worst"] >= 0.95
    assert found["raw_mean_worst"] == pytest.approx(1.0, abs=0.05)


@pytest.mark.slow
@pytest.mark.parametrize("divergence", ["chi2", "kl"])
def test_the_replays_own_policy_weighs_everything_about_one(divergence):
    case = replace(cases([0])[-1], divergence=divergence, same_policy=True)
    found = estimate(case, VARIANTS[0])
    seen = np.isfinite(found.estimated)
    assert found.exact == pytest.approx(np.ones_like(found.exact), abs=1e-6)
    assert found.replay[seen] @ np.abs(found.estimated[seen] - 1) < 0.12
