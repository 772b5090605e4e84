import torch
from common import generator
from made import ACTION, OBS, QUICK, context, rows

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
