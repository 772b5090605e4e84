"""The ratio alone: w = p/q from the discriminator, without TOM's dual Q.

The comparison with TOM shows the effect of the flow constraint.
"""

from typing import Any

import torch

from tom.config import TomConfig
from tom.learners.base import FitContext, Weighting, uniform, weighted
from tom.learners.discriminator import Discriminator, RatioProblem


class RatioLearner:
    """exp of the discriminator's logit, normalised; the settings are those of TOM's discriminator.

    Uniform, and not ready, until the policy has taken `config.warmup` steps in the environment.
    """

    def __init__(
        self, config: TomConfig, obs_dim: int, action_dim: int, generator: torch.Generator
    ) -> None:
        self.config = config
        self.discriminator = Discriminator(obs_dim, action_dim, config, generator)

    def weigh(self, context: FitContext) -> Weighting:
        if context.on_policy_steps < self.config.warmup:
            return uniform(context.replay, ready=False)
        if self.config.discriminator_reset:
            self.discriminator.restart(self.discriminator.fresh(context.generator))
        ratio = RatioProblem.of(context.policy_buffer, context.replay, self.config)
        net, metrics = ratio.solve(self.discriminator, context.generator)
        r = ratio.log_ratio(net)
        raw = (r - r.max()).exp()
        return weighted(raw, log_ratio=r, clipped=True, metrics=metrics)

    def state_dict(self) -> dict[str, Any]:
        return {"discriminator": self.discriminator.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.discriminator.load_state_dict(state["discriminator"])
