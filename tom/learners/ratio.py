"""The ratio alone: w = p/q from the discriminator, without TOM's dual Q.

The comparison with TOM shows the effect of the flow constraint.
"""

from typing import Any

import torch

from tom.config import TomConfig
from tom.data.sampling import normalise
from tom.learners.base import DEGENERATE, FitContext, Weighting, uniform
from tom.learners.discriminator import Discriminator, RatioProblem, discriminator_net


class RatioLearner:
    """exp of the discriminator's logit, normalised; the settings are those of TOM's discriminator.

    Uniform, and not ready, until the policy has taken `config.warmup` steps in the environment.
    """

    def __init__(
        self, config: TomConfig, obs_dim: int, action_dim: int, generator: torch.Generator
    ) -> None:
        self.config = config
        self.dims = obs_dim, action_dim
        self.discriminator = Discriminator(discriminator_net(*self.dims, config, generator), config)
        self.degenerate = 0

    def weigh(self, context: FitContext) -> Weighting:
        if context.on_policy_steps < self.config.warmup:
            return uniform(context.replay, ready=False)
        if self.config.discriminator_reset:
            fresh = discriminator_net(*self.dims, self.config, context.generator)
            self.discriminator.restart(fresh)
        ratio = RatioProblem.of(
            context.policy_buffer, context.replay, self.config.discriminator_input
        )
        net, metrics = ratio.solve(self.discriminator, context.generator)
        log_ratio = ratio.log_ratio(net)
        weights, degenerate = normalise((log_ratio - log_ratio.max()).exp())
        self.degenerate += degenerate
        return Weighting(
            weights=weights,
            log_ratio=log_ratio,
            ready=not degenerate,
            clipped=True,
            metrics={**metrics, "weights/degenerate": float(self.degenerate)},
            notices=(DEGENERATE,) if degenerate else (),
        )

    def state_dict(self) -> dict[str, Any]:
        return {"discriminator": self.discriminator.state_dict(), "degenerate": self.degenerate}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.discriminator.load_state_dict(state["discriminator"])
        self.degenerate = state["degenerate"]
