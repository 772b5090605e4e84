"""Policy distance: a row counts by how near the policy that drew its action is to the current one.

The distance is that at the row's own state. PDML (`tom/learners/pdml.py`) averages it over each
policy's states.
"""

import torch
from torch import Tensor

from tom.config import PolicyDistanceConfig
from tom.learners.base import FitContext, Stateless, Weighting, uniform, weighted
from tom.learners.behaviour import Behaviour, explored_rows


def distance_weights(divergence: Tensor, floor: float) -> Tensor:
    """1 / (KL(pi_now || pi_then) + floor) for divergences of any shape."""
    return 1 / (divergence + floor)


class PolicyDistanceLearner(Stateless):
    """Weights by the divergence of two policies at each row's state; none for exploration.

    It keeps nothing. Uniform, and not ready, until the policy has taken `config.warmup` steps in
    the environment.
    """

    def __init__(self, config: PolicyDistanceConfig) -> None:
        self.config = config

    def weigh(self, context: FitContext) -> Weighting:
        """Raises UserError (`Behaviour.of`)."""
        if context.on_policy_steps < max(self.config.warmup, 1):
            return uniform(context.replay, ready=False)
        chosen = ~explored_rows(context)
        divergence = Behaviour.of(context, chosen).divergence()
        raw = torch.zeros_like(context.replay.reward)
        raw[chosen] = distance_weights(divergence, self.config.floor)
        known = {"behaviour/divergence": float(divergence.median())} if chosen.any() else {}
        return weighted(raw, metrics=known)
