"""The weights of TOM as pure functions: divergence, flow, and the terms of each weight.

With r, g, e and V0 below and V' = E_{a'~pi}[Q(s', a')] every transition has

    y = r + g (1 - e) V' + g e V0 - Q(s, a),    w = f*'(y - lambda) / mean.

**The f-divergence** of the regulariser: the dual objective (paper, eq. 16) holds E_q[f*(y)], the
optimal weights (eq. 17) are f*'(y). The conjugate is taken over x >= 0: a weight is never negative.

**The flow constraint**: the mass flowing into (s', a') equals the mass flowing out. There are
three, which differ in what follows the end of an episode and in the start term. e = 1 at an end,
V0 = E_{mu0,pi}[Q(s0, a0)]:

- discounted (the paper, eq. 16): no restart, so that mass is lost at an end; no term g e V0.
- restart: a termination is followed by a new start, and mass is conserved.
- stationary: the same at g = 1, time limits restart too, and a multiplier lambda holds the mean
  weight at 1. The stream of transitions as it is collected, resets included, satisfies this one.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, fields, replace
from math import log

import torch
from torch import Tensor

from tom.config import TomConfig
from tom.data.transitions import TensorTransitions


@dataclass(frozen=True)
class Divergence:
    """D_f(d || q) = E_q[f(d/q)], its dual term and its weights.

    `dual_term` maps y (..., N), drawn from q, to E_q[f*(y)] or its counterpart for KL, (...,).
    `slope` is f*', elementwise. `multiplier` maps y (..., N) to the lambda (...,) that minimises
    lambda + E_q[f*(y - lambda)], where the weights have mean 1. Weights that are `normalised` have
    mean 1 whatever y is.
    """

    label: str
    dual_term: Callable[[Tensor], Tensor]
    slope: Callable[[Tensor], Tensor]
    multiplier: Callable[[Tensor], Tensor]
    normalised: bool = False

    def weights(self, y: Tensor) -> Tensor:
        """The weights (N,) at y (N,): the slope; normalised ones by the softmax, no overflow."""
        return torch.softmax(y, dim=0) * len(y) if self.normalised else self.slope(y)


def chi2_conjugate(y: Tensor) -> Tensor:
    """f*(y) = (max(0, 1 + y)^2 - 1) / 2, the supremum of xy - (x-1)^2/2 over x >= 0."""
    return ((1 + y).clamp(min=0).square() - 1) / 2


def chi2_slope(y: Tensor) -> Tensor:
    """f*'(y) = max(0, 1 + y)."""
    return (1 + y).clamp(min=0)


def chi2_multiplier(y: Tensor) -> Tensor:
    """lambda (...,) with E max(0, 1 + y - lambda) = 1 over the last axis of y (..., N), exactly.

    With z = y in descending order and the k largest active, lambda_k = (z_1 + ... + z_k + k - N) /
    k; the right k is the largest one whose smallest weight, 1 + z_k - lambda_k, is positive.
    With NaN or infinity in y lambda is not finite: who watches the loss then says so.
    """
    z = y.sort(dim=-1, descending=True).values.to(torch.float64)
    k = torch.arange(1, z.shape[-1] + 1, dtype=z.dtype, device=z.device)
    candidates = (z.cumsum(-1) + k - z.shape[-1]) / k
    active = (1 + z - candidates > 0).sum(-1, keepdim=True)
    # In exact numbers k = 1 always is; NaN, infinity and rounding beyond 1e16 leave none.
    last = (active - 1).clamp(min=0)
    return candidates.gather(-1, last).squeeze(-1).to(y.dtype)


def released_conjugate(y: Tensor) -> Tensor:
    """y^2/2 + y: the released code's parabola, the supremum over every real x."""
    return y.square() / 2 + y


def kl_dual_term(y: Tensor) -> Tensor:
    """log E exp(y): the supremum of E[xy - x log x] over x >= 0 with E[x] = 1."""
    return torch.logsumexp(y, dim=-1) - log(y.shape[-1])


CHI2 = Divergence("chi-square", lambda y: chi2_conjugate(y).mean(-1), chi2_slope, chi2_multiplier)
"""f(x) = (x - 1)^2 / 2"""
DIVERGENCES: dict[str, Divergence] = {
    "chi2": CHI2,
    # f(x) = (x - 1)^2, which bounds KL from above: f* is twice that of chi2 at half the argument.
    "full-chi2": Divergence(
        "full chi-square",
        lambda y: 2 * CHI2.dual_term(y / 2),
        lambda y: chi2_slope(y / 2),
        lambda y: 2 * chi2_multiplier(y / 2),
    ),
    # f(x) = x log x
    "kl": Divergence("KL", kl_dual_term, torch.exp, kl_dual_term, normalised=True),
}
"""by the name in `TomConfig.divergence`"""

# The parabola's slope is 1 + y, with mean 1 if y has mean 0; negative weights are cut.
RELEASED = replace(
    CHI2,
    dual_term=lambda y: released_conjugate(y).mean(-1),
    multiplier=lambda y: y.mean(-1),
)
"""chi-square as in the released code"""


def divergence(config: TomConfig) -> Divergence:
    """The divergence of a configuration; the released conjugate is an option of chi2 alone."""
    released = config.divergence == "chi2" and config.conjugate == "released"
    return RELEASED if released else DIVERGENCES[config.divergence]


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
