"""The flow constraint that TOM's weights obey: what flows into (s', a') equals what flows out.

Three of them, which differ in what comes after the end of an episode and in the start term. With
e = 1 at an end, V0 = E_{mu0,pi}[Q(s0, a0)] and V' = E_{a'~pi}[Q(s', a')] the dual's operator is
(F Q)(s, a, s') = g [(1 - e) V' + e V0] - Q(s, a), without the term e V0 where nothing restarts:

- discounted (the paper, eq. 16): no restart, so that an end takes mass with it.
- restart: a termination is followed by a new start, and mass is conserved.
- stationary: the same at g = 1, time limits restart too, and a multiplier holds the mean weight at
  1. The stream of transitions as it is collected, resets included, obeys this one.
"""

from dataclasses import dataclass

from torch import Tensor

from tom.config import TomConfig
from tom.data.transitions import TensorTransitions


@dataclass(frozen=True)
class Flow:
    """What a constraint says of ends and starts; `discount` is the operator's g."""

    discount: float
    restarts: bool
    normalised: bool

    @staticmethod
    def of(config: TomConfig) -> "Flow":
        """The flow that the settings name."""
        stationary = config.flow == "stationary"
        return Flow(
            discount=1.0 if stationary else config.discount,
            restarts=config.flow != "discounted",
            normalised=stationary,
        )

    def ends(self, rows: TensorTransitions) -> Tensor:
        """e (N,): 1 where an episode ends, for this flow. A time limit ends only a stationary one.

        The value goes on through a time limit; the stream of transitions does not.
        """
        if not self.normalised:
            return rows.terminated
        return (rows.terminated + rows.truncated).clamp(max=1)

    def after(self, following: Tensor, start: Tensor, ends: Tensor) -> Tensor:
        """What Q is worth after a transition: g [(1 - e) V' + e V0], (..., B).

        `following` V' and `ends` e are (..., B), `start` V0 is (..., 1).
        """
        value = self.discount * (1 - ends) * following
        return value + self.discount * ends * start if self.restarts else value

    def shift(self, ends: Tensor) -> Tensor:
        """By how much F Q falls where Q is raised by one everywhere, (N,)."""
        return 1 - self.discount * (ends.new_ones(()) if self.restarts else 1 - ends)
