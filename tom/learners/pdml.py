"""PDML: the rows of a historical policy count by its mean distance to the current one."""

import torch
from torch import Tensor

from tom.config import PdmlConfig
from tom.learners.base import FitContext, Stateless, Weighting, uniform, weighted
from tom.learners.behaviour import Behaviour, explored_rows

LEAST = 1e-6
"""distances below it count as it: the policy has not changed"""


def total_variation(divergence: Tensor) -> Tensor:
    """Pinsker's upper bound sqrt(KL / 2) of the total variation distance, elementwise."""
    return (divergence.clamp(min=0) / 2).sqrt()


def policy_numbers(explored: Tensor, rows_per_policy: int) -> Tensor:
    """The policy of each row (N,), 0 the newest; -1 in exploration.

    On-policy rows, counted from the newest, change policy every `rows_per_policy`.
    """
    chosen = (~explored).to(torch.int64)
    newer = chosen.flip(0).cumsum(0).flip(0) - chosen
    return torch.where(explored, -torch.ones_like(newer), newer // rows_per_policy)


def policy_weights(distance: Tensor, count: Tensor, config: PdmlConfig) -> tuple[Tensor, Tensor]:
    """The weight of a row of each of K policies (K,), the newest first, and of exploration's.

    `distance` (K,) is each policy's to the current one, `count` (K,) its rows. 1 / distance, and
    for the newest one `newest_rate` of all weight, or the largest of the others if that is more.
    """
    weight = 1 / distance.clamp(min=LEAST)
    if len(weight) > 1:
        others = (weight[1:] * count[1:]).sum() / count[0]
        rate = config.newest_rate / (1 - config.newest_rate)
        weight[0] = torch.maximum(others * rate, weight[1:].max())
    return weight, config.exploration * weight[-1]


class PdmlLearner(Stateless):
    """Weights of whole policies; it keeps nothing, for the rows hold their policies.

    Uniform, and not ready, until the policy has taken `config.warmup` steps in the environment, and
    where exploration collected every row.
    """

    def __init__(self, config: PdmlConfig) -> None:
        self.config = config

    def weigh(self, context: FitContext) -> Weighting:
        """Raises UserError (`Behaviour.of`)."""
        explored = explored_rows(context)
        if context.on_policy_steps < max(self.config.warmup, 1) or bool(explored.all()):
            return uniform(context.replay, ready=False)
        bound = total_variation(Behaviour.of(context, ~explored).divergence()).to(torch.float64)
        number = policy_numbers(explored, self.config.rows_per_policy)
        of = number[~explored]
        count = torch.bincount(of)
        distance = torch.bincount(of, bound) / count
        weight, exploration = policy_weights(distance, count, self.config)
        rows = torch.where(explored, exploration, weight[number.clamp(min=0)])
        return weighted(
            rows.to(context.replay.obs), metrics={"behaviour/policies": float(len(count))}
        )
