"""Policy distance: a row counts by how near the policy that drew its action is to the current one.

The distance is that at the row's own state. PDML (`tom/learners/pdml.py`) averages it over each
policy's states.
"""

from typing import Any

import torch
from torch import Tensor

from tom.config import PolicyDistanceConfig
from tom.data.sampling import normalise
from tom.learners.base import DEGENERATE, FitContext, Weighting, uniform
from tom.learners.behaviour import Behaviour


def distance_weights(divergence: Tensor, explored: Tensor, floor: float) -> Tensor:
    """1 / (KL(pi_now || pi_then) + floor) for divergences (N,), 0 for exploration rows: (N,)."""
    return torch.where(explored, torch.zeros_like(divergence), 1 / (divergence + floor))


class PolicyDistanceLearner:
    """Weights by the divergence of two policies at each row's state; it keeps nothing.

    Uniform, and not ready, until the policy has taken `config.warmup` steps in the environment.
    """

    def __init__(self, config: PolicyDistanceConfig) -> None:
        self.config = config

    def weigh(self, context: FitContext) -> Weighting:
        """Raises UserError (`Behaviour.of`)."""
        if context.on_policy_steps < max(self.config.warmup, 1):
            return uniform(context.replay, ready=False)
        both = Behaviour.of(context)
        divergence = both.divergence()
        weights = distance_weights(divergence, both.explored, self.config.floor)
        weights, degenerate = normalise(weights)
        known = divergence[~both.explored]
        return Weighting(
            weights=weights,
            ready=not degenerate,
            metrics={"behaviour/divergence": float(known.median())} if len(known) else {},
            notices=(DEGENERATE,) if degenerate else (),
        )

    def state_dict(self) -> dict[str, Any]:
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        pass
