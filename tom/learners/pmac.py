"""PMAC: a transition has more weight if a more recent policy collected it."""

import torch
from torch import Tensor

from tom.config import PmacConfig
from tom.data.sampling import normalise
from tom.learners.base import FitContext, Stateless, Weighting


def recency_probabilities(policy_version: Tensor, decay: float) -> Tensor:
    """Probability of each transition (N,) float64, summing to one (paper, appendix C.2).

    The oldest policy's transitions start by sharing 1 equally. At each policy change p <- decay p
    and the new policy's transitions share 1 - decay equally. With K changes the transitions of
    the k-th policy share (1 - decay) decay^(K-k), those of the oldest decay^K. A version number
    without transitions does not count as a change.

    policy_version (N,): which policy collected each row, growing with time, in any row order.
    """
    _, version, count = torch.unique(policy_version, return_inverse=True, return_counts=True)
    changes = len(count) - 1
    later = torch.arange(changes, -1, -1, dtype=torch.float64, device=count.device)
    share = decay**later
    share[1:] *= 1 - decay
    return (share / count)[version]


class PmacLearner(Stateless):
    """Recency weights over policy versions."""

    def __init__(self, config: PmacConfig) -> None:
        self.config = config

    def weigh(self, context: FitContext) -> Weighting:
        p = recency_probabilities(context.policy_version, self.config.decay)
        weights, _ = normalise(p)
        return Weighting(weights.to(context.replay.obs))
