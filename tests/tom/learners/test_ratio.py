import pytest
import torch
from made import ACTION, OBS, QUICK, context, generator, rows

from tom.learners.ratio import RatioLearner


def test_weights_are_the_odds_of_the_discriminator():
    replay, policy_rows = rows(2000), rows(400, seed=1, shift=0.5)
    learner = RatioLearner(QUICK, OBS, ACTION, generator())
    found = learner.weigh(context(replay, policy_rows))
    assert found.log_ratio is not None
    expected = found.log_ratio.exp() / found.log_ratio.exp().mean()
    torch.testing.assert_close(found.weights, expected)
    assert found.clipped
    # The policy's rows lie further up: so does the weighted buffer.
    up = replay.obs.mean(1)
    assert float((found.weights * up).mean()) > float(up.mean()) + 0.1


def test_it_is_uniform_until_the_policy_has_acted_long_enough():
    learner = RatioLearner(QUICK.but(warmup=100), OBS, ACTION, generator())
    found = learner.weigh(context(rows(200), on_policy_steps=99))
    assert not found.ready
    assert float(found.weights.std()) == 0


def test_it_goes_on_from_its_state():
    config = QUICK.but(discriminator_reset=False)
    first = RatioLearner(config, OBS, ACTION, generator())
    first.weigh(context(rows(200)))
    second = RatioLearner(config, OBS, ACTION, generator(9))
    second.load_state_dict(first.state_dict())
    again = [one.weigh(context(rows(200), seed=4)).weights for one in (first, second)]
    torch.testing.assert_close(*again, rtol=0, atol=0)


@pytest.mark.parametrize("steps", [0, 60])
def test_a_discriminator_without_steps_still_gives_usable_weights(steps: int):
    found = RatioLearner(QUICK.but(discriminator_steps=steps), OBS, ACTION, generator()).weigh(
        context(rows(200))
    )
    assert float(found.weights.mean()) == pytest.approx(1.0, abs=1e-5)
