"""The f-divergences of TOM's regulariser and their convex conjugates, as pure functions.

With y = r + g E_{a'}[Q(s', a')] - Q(s, a) the dual objective (eq. 16) holds E_q[f*(y)] and the
optimal weights (eq. 17) are f*'(y). The conjugate is taken over x >= 0: a weight is never negative.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import log

import torch
from torch import Tensor

from tom.config import TomConfig


@dataclass(frozen=True)
class Divergence:
    """D_f(d || q) = E_q[f(d/q)], its dual term and its weights.

    `generator` is f itself and `slope` f*', both elementwise. `dual_term` maps y (..., N), drawn
    from q, to E_q[f*(y)] or its counterpart for KL, (...,). `multiplier` maps y (..., N) to the
    lambda (...,) that minimises lambda + E_q[f*(y - lambda)], where the weights have mean 1.
    `weights` maps y (N,) to the weights (N,): the slope, or, if `normalised`, weights that have
    mean 1 whatever y is.
    """

    label: str
    generator: Callable[[Tensor], Tensor]
    dual_term: Callable[[Tensor], Tensor]
    slope: Callable[[Tensor], Tensor]
    multiplier: Callable[[Tensor], Tensor]
    weights: Callable[[Tensor], Tensor]
    normalised: bool = False


def chi2_generator(x: Tensor) -> Tensor:
    """f(x) = (x - 1)^2 / 2."""
    return (x - 1).square() / 2


def chi2_conjugate(y: Tensor) -> Tensor:
    """f*(y) = (max(0, 1 + y)^2 - 1) / 2, the supremum of xy - (x-1)^2/2 over x >= 0."""
    return ((1 + y).clamp(min=0).square() - 1) / 2


def chi2_weights(y: Tensor) -> Tensor:
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


def full_chi2_generator(x: Tensor) -> Tensor:
    """f(x) = (x - 1)^2, the chi-square divergence that upper-bounds KL."""
    return (x - 1).square()


def full_chi2_conjugate(y: Tensor) -> Tensor:
    """f*(y) = max(0, 1 + y/2)^2 - 1, the supremum of xy - (x-1)^2 over x >= 0."""
    return (1 + y / 2).clamp(min=0).square() - 1


def full_chi2_weights(y: Tensor) -> Tensor:
    """f*'(y) = max(0, 1 + y/2)."""
    return (1 + y / 2).clamp(min=0)


def full_chi2_multiplier(y: Tensor) -> Tensor:
    """lambda (...,) with E max(0, 1 + (y - lambda)/2) = 1 over the last axis of y (..., N)."""
    return 2 * chi2_multiplier(y / 2)


def kl_generator(x: Tensor) -> Tensor:
    """f(x) = x log x, with 0 log 0 = 0."""
    return torch.special.xlogy(x, x)


def kl_dual_term(y: Tensor) -> Tensor:
    """log E exp(y): the supremum of E[xy - x log x] over x >= 0 with E[x] = 1."""
    return torch.logsumexp(y, dim=-1) - log(y.shape[-1])


def kl_weights(y: Tensor) -> Tensor:
    """exp(y) / E exp(y), without overflow."""
    return torch.softmax(y, dim=0) * len(y)


DIVERGENCES: dict[str, Divergence] = {
    "chi2": Divergence(
        "chi-square",
        chi2_generator,
        lambda y: chi2_conjugate(y).mean(-1),
        chi2_weights,
        chi2_multiplier,
        chi2_weights,
    ),
    "full-chi2": Divergence(
        "full chi-square",
        full_chi2_generator,
        lambda y: full_chi2_conjugate(y).mean(-1),
        full_chi2_weights,
        full_chi2_multiplier,
        full_chi2_weights,
    ),
    "kl": Divergence(
        "KL",
        kl_generator,
        kl_dual_term,
        torch.exp,
        kl_dual_term,
        kl_weights,
        normalised=True,
    ),
}
"""by the name in `TomConfig.divergence`"""

# The parabola's slope is 1 + y, with mean 1 if y has mean 0; negative weights are cut.
RELEASED = replace(
    DIVERGENCES["chi2"],
    dual_term=lambda y: released_conjugate(y).mean(-1),
    multiplier=lambda y: y.mean(-1),
)
"""chi-square as in the released code"""


def divergence(config: TomConfig) -> Divergence:
    """The divergence of a configuration; the released conjugate is an option of chi2 alone."""
    released = config.divergence == "chi2" and config.conjugate == "released"
    return RELEASED if released else DIVERGENCES[config.divergence]
