"""Action ratio: the importance ratio of each row's action, which needs no network."""

import torch
from torch import Tensor

from tom.config import ActionRatioConfig
from tom.learners.base import FitContext, Stateless, Weighting, uniform, weighted
from tom.learners.behaviour import Behaviour, explored_rows


def ratio_weights(log_ratio: Tensor, clip: float) -> Tensor:
    """min(pi_now(a|s) / pi_then(a|s), clip) from its logarithm (N,)."""
    return log_ratio.exp().clamp(max=clip)


class ActionRatioLearner(Stateless):
    """Weights by the action alone: states that the policy has left count as before.

    Uniform, and not ready, as long as there is nothing but exploration.
    """

    def __init__(self, config: ActionRatioConfig) -> None:
        self.config = config

    def weigh(self, context: FitContext) -> Weighting:
        """Raises UserError (`Behaviour.of`)."""
        if context.on_policy_steps == 0:
            return uniform(context.replay, ready=False)
        every = torch.ones_like(explored_rows(context))
        log_ratio = Behaviour.of(context, every).log_ratio(context.replay.action)
        clipped = (log_ratio.exp() > self.config.clip).to(log_ratio).mean()
        weights = ratio_weights(log_ratio, self.config.clip)
        return weighted(weights, metrics={"behaviour/clipped": float(clipped)})
