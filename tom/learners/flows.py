"""The flow constraint on TOM's weights: the mass flowing into (s', a') equals the mass flowing out.

There are three, which differ in what follows the end of an episode and in the start term. With
e = 1 at an end, V0 = E_{mu0,pi}[Q(s0, a0)] and V' = E_{a'~pi}[Q(s', a')] the dual's operator is
(F Q)(s, a, s') = g [(1 - e) V' + e V0] - Q(s, a), without the term e V0 where nothing restarts:

- discounted (the paper, eq. 16): no restart, so that mass is lost at an end.
- restart: a termination is followed by a new start, and mass is conserved.
- stationary: the same at g = 1, time limits restart too, and a multiplier holds the mean weight at
  1. The stream of transitions as it is collected, resets included, satisfies this one.
"""

from dataclasses import dataclass

from torch import Tensor

from tom.config import TomConfig
from tom.data.transitions import TensorTransitions


@dataclass(frozen=True)
class Flow:
    """How a constraint treats ends and starts; `discount` is the operator's g."""

    discount: float
    restarts: bool
    normalised: bool

    @staticmethod
    def of(config: TomConfig) -> "Flow":
        """The flow chosen by the settings."""
        stationary = config.flow == "stationary"
        return Flow(
            discount=1.0 if stationary else config.discount,
            restarts=config.flow != "discounted",
            normalised=stationary,
        )

    def ends(self, rows: TensorTransitions) -> Tensor:
        """e (N,): 1 if an episode ends for this flow; time limits count only in a stationary one.

        The value continues through a time limit, but the stream of transitions does not.
        """
        if not self.normalised:
            return rows.terminated
        return (rows.terminated + rows.truncated).clamp(max=1)

    def after(self, following: Tensor, start: Tensor, ends: Tensor) -> Tensor:
        """The value of Q after a transition: g [(1 - e) V' + e V0], (..., B).

        `following` V' and `ends` e are (..., B), `start` V0 is (..., 1).
        """
        value = self.going_on(following, ends)
        return value + self.restarting(start, ends) if self.restarts else value

    def going_on(self, following: Tensor, ends: Tensor) -> Tensor:
        """g (1 - e) V', (..., B)."""
        return self.discount * (1 - ends) * following

    def restarting(self, start: Tensor, ends: Tensor) -> Tensor:
        """g e V0, (..., B); `start` V0 is (..., 1)."""
        return self.discount * ends * start

    def shift(self, ends: Tensor) -> Tensor:
        """The decrease of F Q when Q is raised by one everywhere, (N,); () if ends restart."""
        return 1 - self.discount * (ends.new_ones(()) if self.restarts else 1 - ends)
