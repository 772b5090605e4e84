from dataclasses import replace

import pytest
import torch
from common import generator, online, present
from made import ACTION, OBS, QUICK, LinearGaussian, context, rows

from tom.config import ModelConfig, OnlineConfig, RolloutConfig
from tom.learners import LEARNERS, make_learner
from tom.learners.base import Weighting
from tom.training.presets import resolve

AT_ONCE = ("mle", "pmac", "pmer")
"""learners that weigh from the first fit on"""


def config(name: str) -> OnlineConfig:
    return online("hopper", name, {"tom": QUICK.model_dump()}, "paper")


@pytest.mark.parametrize("name", LEARNERS)
def test_every_learner_weighs_a_buffer(name):
    learner = make_learner(name, config(name), OBS, ACTION, generator())
    version = torch.arange(100) // 25
    found = learner.weigh(
        context(
            rows(100),
            policy_version=version,
            value_gradient=lambda s: torch.ones(2, *s.shape),
            behaviour=torch.randn(100, 2 * ACTION, generator=generator()),
            model_errors=lambda: torch.rand(100, generator=generator()),
            policy=LinearGaussian(),
        )
    )
    assert found.ready
    assert found.weights.shape == (100,)
    assert found.clipped == LEARNERS[name].clipped
    assert float(found.weights.mean()) == pytest.approx(1.0, abs=1e-4)
    assert (name == "mle") == bool((found.weights == 1).all() and found.per_dim is None)


@pytest.mark.parametrize("lacks", ["value", "steps"])
@pytest.mark.parametrize("name", LEARNERS)
def test_weights_are_uniform_until_there_is_what_a_learner_follows(name: str, lacks: str):
    learner = make_learner(name, config(name), OBS, ACTION, generator())
    behaviour = torch.randn(100, 2 * ACTION, generator=generator())
    version, policy = torch.arange(100) // 25, LinearGaussian()
    given = context(rows(100), policy_version=version, behaviour=behaviour, policy=policy)
    if lacks == "steps":
        value, error = (lambda s: torch.ones(2, *s.shape)), (lambda: torch.rand(100))
        given = replace(given, on_policy_steps=0, value_gradient=value, model_errors=error)
    found = learner.weigh(given)
    needs = LEARNERS[name].follows_value or name == "pmer"
    assert found.ready is (name in AT_ONCE if lacks == "steps" else not needs)
    assert found.ready or bool((found.weights == 1).all() and found.per_dim is None)


def test_vagrams_ensemble_is_another_model_unless_the_user_wants_one():
    def kind(learner: str, **overrides: object) -> str:
        return resolve("hopper", learner, overrides=overrides).model_dump()["model"]["kind"]

    assert kind("vagram") == "mdn"
    assert kind("vagram-ensemble") == "mean-ensemble"
    assert kind("vagram-ensemble", model={"kind": "ensemble"}) == "ensemble"


def test_a_defensive_mixture_leaves_no_row_below_its_share():
    weighting = Weighting(torch.tensor([0.0, 0.5, 2.5]))
    rows, _ = weighting.for_fit(ModelConfig(uniform_share=0.5))
    assert rows.tolist() == [0.5, 0.75, 1.75]
    starts = present(weighting.for_starts(RolloutConfig(uniform_share=0.2)))
    assert starts.tolist() == pytest.approx([0.2, 0.6, 2.2])
    assert weighting.for_starts(RolloutConfig(weighted_starts=False)) is None


def test_a_defensive_mixture_reaches_the_dimensions_and_draws_no_rows():
    weighting = Weighting(torch.ones(2), per_dim=torch.tensor([[0.0, 2.0], [1.0, 1.0]]))
    rows, per_dim = weighting.for_fit(ModelConfig(uniform_share=0.5))
    assert rows.tolist() == [1.0, 1.0]
    assert per_dim is not None
    assert per_dim.tolist() == [[0.5, 1.5], [1.0, 1.0]]
