"""A learner: the better a transition was paid, the more it counts.

tom train --env hopper --learner reward --plugin docs/examples/reward.py
"""

from typing import Any

import torch

from tom.data.sampling import normalise
from tom.learners.base import FitContext, Weighting


class RewardLearner:
    """Weights in proportion to exp(r), r the rewards in units of their standard deviation."""

    def weigh(self, context: FitContext) -> Weighting:
        reward = context.replay.reward.double()
        scaled = (reward - reward.mean()) / reward.std().clamp_min(1e-8)
        weights, _ = normalise(torch.exp(scaled))
        return Weighting(weights.to(context.replay.obs))

    def state_dict(self) -> dict[str, Any]:
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        pass


def register(registry):
    registry.learner("reward", "Reward", lambda config, obs_dim, action_dim, gen: RewardLearner())
