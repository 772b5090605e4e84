"""The learners that use the policy then and now, and PMER, against other ways to compute them."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from common import one_line, present
from made import ACTION, LinearGaussian, context, rows, uniform_policy
from torch import Tensor
from torch.distributions import Normal, TransformedDistribution, Uniform, kl_divergence
from torch.distributions.transforms import TanhTransform

from tom.config import ActionRatioConfig, PdmlConfig, PmerConfig, PolicyDistanceConfig
from tom.learners.action_ratio import ActionRatioLearner
from tom.learners.base import FitContext
from tom.learners.behaviour import Behaviour
from tom.learners.pdml import PdmlLearner, policy_numbers
from tom.learners.pmer import PmerLearner
from tom.learners.policy_distance import PolicyDistanceLearner

N, EXPLORED = 120, 20


def given(**changes: object) -> FitContext:
    """Twenty exploration rows, then a hundred of policies that drift from slope 0 to 1."""
    replay = rows(N)
    slope = torch.linspace(0, 1, N)[:, None]
    then = torch.cat((slope * replay.obs[:, :ACTION], -0.5 - slope.expand(-1, ACTION) / 2), 1)
    then[:EXPLORED] = torch.nan
    version = (torch.arange(N) - EXPLORED + 1).clamp(min=0)
    usual = {"policy_version": version, "behaviour": then, "policy": LinearGaussian()}
    return context(replay, **usual | changes)  # pyright: ignore[reportArgumentType]


def every(asked: FitContext) -> Behaviour:
    return Behaviour.of(asked, torch.ones(N, dtype=torch.bool))


def normals(asked: FitContext) -> tuple[Normal, Normal]:
    """The Gaussians now and then of all rows but exploration, (N - EXPLORED, A)."""
    obs, then = asked.replay.obs[EXPLORED:], asked.behaviour
    assert then is not None
    mean, log_std = LinearGaussian().gaussian(obs)
    mean_then, log_std_then = then[EXPLORED:].chunk(2, 1)
    return Normal(mean, log_std.exp()), Normal(mean_then, log_std_then.exp())


def test_the_divergence_is_that_of_the_gaussians_and_grows_with_age():
    asked = given()
    found = every(asked).divergence()
    assert bool(found[:EXPLORED].isnan().all())
    torch.testing.assert_close(found[EXPLORED:], kl_divergence(*normals(asked)).sum(1))
    assert found[EXPLORED : EXPLORED + 20].mean() > 10 * found[-20:].mean()


def test_the_ratio_is_that_of_squashed_densities():
    asked = given()
    action = asked.replay.action
    found = every(asked).log_ratio(action)
    now, then = (
        TransformedDistribution(each, [TanhTransform()]).log_prob(action[EXPLORED:]).sum(1)
        for each in normals(asked)
    )
    torch.testing.assert_close(found[EXPLORED:], now - then, rtol=1e-3, atol=1e-3)
    mean, log_std = LinearGaussian().gaussian(asked.replay.obs[:EXPLORED])
    squashed = TransformedDistribution(Normal(mean, log_std.exp()), [TanhTransform()])
    random = squashed.log_prob(action[:EXPLORED]) - Uniform(-1.0, 1.0).log_prob(action[:EXPLORED])
    torch.testing.assert_close(found[:EXPLORED], random.sum(1), rtol=1e-3, atol=1e-3)


def test_an_action_at_its_bound_has_a_finite_ratio():
    replay = rows(N)
    replay.action[:] = 1.0
    assert bool(every(given()).log_ratio(replay.action).isfinite().all())


def test_policy_distance_by_hand():
    asked = given()
    found = PolicyDistanceLearner(PolicyDistanceConfig(floor=0.2)).weigh(asked)
    raw = 1 / (kl_divergence(*normals(asked)).sum(1) + 0.2)
    expected = torch.cat((torch.zeros(EXPLORED), raw))
    torch.testing.assert_close(found.weights, expected * N / expected.sum())
    assert found.ready


def test_pdml_by_a_loop_over_policies():
    asked, config = given(), PdmlConfig(rows_per_policy=30, newest_rate=0.4, exploration=0.05)
    found = PdmlLearner(config).weigh(asked).weights
    now, then = normals(asked)
    bound = (kl_divergence(now, then).sum(1) / 2).sqrt().tolist()
    # From the newest row back: 30, 30, 30 and the oldest 10.
    policies = [bound[70:], bound[40:70], bound[10:40], bound[:10]]
    of_a_row = [len(each) / sum(each) for each in policies]
    others = sum(w * len(each) for w, each in zip(of_a_row[1:], policies[1:], strict=True))
    of_a_row[0] = max(0.4 / 0.6 * others / 30, *of_a_row[1:])
    raw = [0.05 * of_a_row[3]] * EXPLORED
    for weight, each in reversed(list(zip(of_a_row, policies, strict=True))):
        raw += [weight] * len(each)
    np.testing.assert_allclose(found, np.array(raw) * N / sum(raw), rtol=1e-4)
    policy_rows = found[EXPLORED:]
    assert float(policy_rows[-30:].sum() / policy_rows.sum()) == pytest.approx(0.4, abs=1e-4)


def test_of_exploration_alone_pdml_makes_even_weights():
    asked = given()
    alone = replace(asked, policy_version=torch.zeros_like(asked.policy_version))
    found = PdmlLearner(PdmlConfig()).weigh(alone)
    assert found.weights.tolist() == [1.0] * N


def test_exploration_between_policies_belongs_to_none():
    explored = torch.tensor([True, False, False, True, False, False, False])
    assert policy_numbers(explored, 2).tolist() == [-1, 2, 1, -1, 1, 0, 0]


def test_action_ratios_are_clipped_and_scaled():
    asked = given()
    log_ratio = every(asked).log_ratio(asked.replay.action)
    found = ActionRatioLearner(ActionRatioConfig(clip=2.0)).weigh(asked)
    expected = np.minimum(np.exp(log_ratio.numpy()), 2.0)
    np.testing.assert_allclose(found.weights, expected / expected.mean(), rtol=1e-4)
    assert found.metrics["behaviour/clipped"] == pytest.approx(
        np.mean(log_ratio.numpy() > np.log(2))
    )


def test_pmer_is_a_mixture_of_uniform_rows_and_rows_by_error():
    error = torch.tensor([0.0, 1.0, 2.0, 5.0])
    found = PmerLearner(PmerConfig(share=0.25, sharpness=2)).weigh(
        context(rows(4), model_errors=lambda: error)
    )
    assert found.weights.tolist() == pytest.approx(
        [0.75 + 0.25 * e * e * 4 / 30 for e in (0, 1, 2, 5)]
    )
    assert not PmerLearner(PmerConfig()).weigh(context(rows(4))).ready  # before the first fit


def lacking(row: int) -> Tensor:
    then = present(given().behaviour)
    then[row] = torch.nan
    return then


@pytest.mark.parametrize(
    ("changes", "lacks"),
    [({"behaviour": None}, 100), ({"behaviour": lacking(50)}, 1), ({"policy": uniform_policy}, 0)],
)
def test_what_is_missing_is_one_line(changes: dict[str, object], lacks: int):
    with one_line(f"^{lacks} of 120" if lacks else "^the policy of interest"):
        PolicyDistanceLearner(PolicyDistanceConfig()).weigh(given(**changes))
