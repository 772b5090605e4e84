from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest
import torch
from common import generator, online
from made import ACTION, OBS, QUICK, context, rows, uniform_policy

from tom.config import TomConfig
from tom.data.transitions import Transitions
from tom.events import Metrics
from tom.learners.base import Weighting
from tom.learners.tom import TomLearner, occupancy_weights
from tom.studies.tabular_estimates import Case, Variant, estimate
from tom.training.watch import Watch


def learner(config: TomConfig = QUICK) -> TomLearner:
    return TomLearner(config, OBS, ACTION, generator(5))


def weigh(replay: Transitions, policy_rows: Transitions, config: TomConfig = QUICK) -> Weighting:
    return occupancy_weights(
        replay, policy_rows, uniform_policy, torch.zeros(4, OBS), config, generator(2)
    )


@pytest.mark.parametrize("divergence", ["chi2", "full-chi2", "kl"])
@pytest.mark.parametrize("discriminator", [True, False])
def test_weights_have_mean_one_and_favour_the_policys_region(divergence, discriminator):
    near, far = rows(300, seed=1, shift=2.0), rows(900, seed=2, shift=-1.0)
    config = QUICK.but(divergence=divergence, discriminator=discriminator, q_steps=150)
    replay = Transitions.concatenate([near, far])
    found = weigh(replay, near[:200], config)
    assert float(found.weights.mean()) == pytest.approx(1.0, abs=1e-4)
    assert (found.weights >= 0).all()
    assert found.weights[:300].mean() > found.weights[300:].mean()
    assert found.log_ratio is not None
    assert found.log_ratio.shape == (1200,)


def test_numpy_and_tensors_give_the_same_bits_and_seeds_decide_them():
    replay, policy_rows = rows(300), rows(60, seed=3)
    starts = torch.zeros(4, OBS)
    tensors = weigh(replay, policy_rows)
    arrays = occupancy_weights(
        replay.numpy(), policy_rows.numpy(), uniform_policy, starts.numpy(), QUICK, generator(2)
    )
    for name in ("weights", "log_ratio"):
        assert torch.equal(getattr(tensors, name), getattr(arrays, name))
    float64 = Transitions(*(np.asarray(x, np.float64) for x in vars(replay.numpy()).values()))
    assert torch.equal(weigh(float64, policy_rows).weights, tensors.weights)
    other = occupancy_weights(replay, policy_rows, uniform_policy, starts, QUICK, generator(3))
    assert not torch.equal(other.weights, tensors.weights)


def test_state_holds_all_that_goes_on():
    tom = learner(QUICK.but(discriminator_reset=False))
    again = TomLearner(tom.config, OBS, ACTION, generator(99))
    tom.weigh(context(rows(200)))
    again.load_state_dict(deepcopy(tom.state_dict()))
    first, second = (t.weigh(context(rows(200), seed=8)) for t in (tom, again))
    assert torch.equal(first.weights, second.weights)


def test_q_goes_on_from_fit_to_fit_unless_reset():
    for reset in (False, True):
        tom = learner(QUICK.but(q_reset=reset))
        for _ in range(2):
            tom.weigh(context(rows(200)))
        steps = tom.q.optimiser.taken[0]
        assert steps == QUICK.q_steps * (1 if reset else 2)


@pytest.mark.fault
@pytest.mark.quick
def test_a_discriminator_that_separates_perfectly__weights_stay_finite_and_the_run_says_so():
    config = QUICK.but(q_steps=20, discriminator_lr=1e-2)
    found = weigh(rows(400), rows(100, seed=1, shift=50.0), config)
    assert found.metrics["discriminator/accuracy"] == 1.0
    assert torch.isfinite(found.weights).all()
    assert float(found.weights.mean()) == pytest.approx(1.0, abs=1e-4)
    [notice] = Watch(online("hopper", "tom")).check(Metrics(80, dict(found.metrics)))
    assert notice.kind == "perfect-discriminator"
    assert "--tom.label-smoothing" in notice.message


@pytest.mark.parametrize("bias", [1e6, float("nan")])
def test_unusable_weights_fall_back_to_uniform_and_are_told(bias):
    tom = learner()
    with torch.no_grad():  # y = r - (1 - g) Q far below -1 everywhere, or not a number
        tom.q.net.biases[-1].fill_(bias)
    found = tom.weigh(context(rows(200)))
    assert not found.ready
    assert (found.weights == 1).all()
    assert "degenerate-weights" in dict(found.notices)


def test_starts_that_the_replay_never_saw_are_told():
    config = QUICK.but(q_steps=400, q_lr=3e-3, discount=0.9)
    found = occupancy_weights(
        rows(1000),
        rows(100, seed=1),
        uniform_policy,
        torch.full((20, OBS), 8.0),
        config,
        generator(),
    )
    assert "runaway-dual" in dict(found.notices)
    assert found.metrics["dual/start_gap"] > 1


def test_kl_on_episodes_that_terminate_is_told():
    """Normalised weights cannot lose the mass that ends: Q squeezes those rows out instead."""
    replay = rows(300)
    some = replace(replay, terminated=(torch.arange(300) % 10 == 0).float())
    config = QUICK.but(divergence="kl", q_steps=300, q_lr=3e-3, discount=0.9)
    told, quiet = weigh(some, replay[:60], config), weigh(replay, replay[:60], config)
    assert "kl-drops-terminations" in dict(told.notices)
    assert quiet.notices == ()
    assert told.weights[::10].mean() < 0.5
    assert weigh(some, replay[:60], config.but(divergence="chi2")).notices == ()
    kept = weigh(some, replay[:60], config.but(flow="stationary"))  # there no end costs mass
    assert "kl-drops-terminations" not in dict(kept.notices)


SMALL = {
    "q_hidden": 64,
    "discriminator_hidden": 64,
    "q_steps": 500,
    "discriminator_steps": 500,
    "discriminator_lr": 1e-3,
    "parameter_average": 0.99,
}


@pytest.mark.parametrize(("divergence", "support"), [("chi2", True), ("kl", True), ("chi2", False)])
def test_estimates_exact_weights_of_a_small_mdp(divergence, support):
    case = Case(0, 2, 0.9, divergence, states=5, actions=2, replay=20_000, uniform=(0.0, 0.3))
    changes = {**SMALL, "action_samples": 5}
    found = estimate((case, Variant("small", changes=changes, support=support)))
    assert found.row["l1"] < (0.12 if support else 0.25)
    assert found.row["spearman"] > 0.95
    assert found.row["raw_mean"] == pytest.approx(1.0, abs=0.05)
