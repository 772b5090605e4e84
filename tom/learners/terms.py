"""The terms of TOM's weights for each row: they explain why a transition has its weight.

With g, e and V0 of the flow (`tom.learners.flows`) and V' = E_{a'~pi}[Q(s', a')]

    y = r + g (1 - e) V' + g e V0 - Q(s, a),    w = f*'(y - lambda) / mean,

where the restart term g e V0 exists for flows that conserve mass, and the level lambda for the
stationary flow and for KL, where lambda is log E exp(y).
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from tom.config import TomConfig
from tom.learners.divergences import divergence
from tom.learners.flows import Flow


@dataclass(frozen=True)
class Terms:
    """The four terms of y, (N,) each, for the N transitions of a replay buffer."""

    log_ratio: Tensor  # r
    now: Tensor  # Q(s, a)
    following: Tensor  # g (1 - e) E_{a'~pi}[Q(s', a')]
    restart: Tensor  # g e E_{mu0,pi}[Q(s0, a0)], zero for flows without restart

    @staticmethod
    def named() -> tuple[str, ...]:
        """The names of the terms in the record, r first."""
        return tuple(field.name for field in fields(Terms))

    def argument(self, config: TomConfig) -> Tensor:
        """y (N,)."""
        after = self.following + self.restart if Flow.of(config).restarts else self.following
        return self.log_ratio + after - self.now

    def level(self, config: TomConfig) -> Tensor:
        """lambda, (): it makes the mean weight 1; zero if only the division by the mean does so.

        Under KL it is log E exp(y).
        """
        f, y = divergence(config), self.argument(config)
        if not (Flow.of(config).normalised or f.normalised):
            return y.new_zeros(())
        return f.multiplier(y)

    def raw(self, config: TomConfig) -> Tensor:
        """f*'(y - lambda), (N,), before the division by its mean."""
        f, y = divergence(config), self.argument(config)
        return f.weights(y - f.multiplier(y) if Flow.of(config).normalised else y)

    def recorded(self) -> dict[str, Tensor]:
        """All terms by name except r, which is recorded separately."""
        return {name: getattr(self, name) for name in Terms.named()[1:]}


def of_recorded(columns: Mapping[str, Tensor]) -> Terms | None:
    """Terms (N,) from columns by name; None if one is missing."""
    if not set(Terms.named()) <= columns.keys():
        return None
    return Terms(*(torch.as_tensor(columns[name]) for name in Terms.named()))
