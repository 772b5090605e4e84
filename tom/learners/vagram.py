"""VaGram: each dimension of a transition is weighted by the gradient of the value function."""

from collections.abc import Callable

import torch
from torch import Tensor

from tom.config import VagramConfig
from tom.data.sampling import normalise
from tom.data.scaling import Scaling
from tom.learners.base import DEGENERATE, FitContext, Stateless, Weighting, uniform
from tom.nn.mlp import rows_at_once

CHUNK = 4096  # rows differentiated at once; they stay in the processor's cache


def value_gradient_weights(
    next_obs: Tensor, scale: Tensor, value_gradient: Callable[[Tensor], Tensor]
) -> Tensor:
    """(scale_d dV_k/ds'_d)^2, averaged over the K value heads, (N, O).

    The model's likelihood is that of z-scored targets, so one unit of error in dimension d is
    scale_d units of s'_d. Heads are averaged after squaring, so that their gradients cannot cancel.
    `value_gradient` maps states (B, O) to dV_k/ds, (K, B, O). Rows with a terminal s' are treated
    like others, although the value function was never trained there.
    """
    size = rows_at_once(next_obs.device, CHUNK)
    parts = [value_gradient(rows).square().mean(0) for rows in next_obs.split(size)]
    return torch.cat(parts) * scale.square()


def clip_rows(per_dim: Tensor, quantile: float) -> Tensor:
    """Rows (N, O) scaled down so that no row's mean exceeds a quantile of the rows' means.

    A row keeps the proportions of its dimensions: clipping changes the weight of a transition, not
    the balance of its dimensions.
    """
    mean = per_dim.mean(1)
    ordered = mean.sort().values  # torch.quantile refuses more than 2^24 rows
    bound = ordered[min(int(quantile * len(ordered)), len(ordered) - 1)]
    factor = torch.where(mean > bound, bound / mean, torch.ones_like(mean))
    return per_dim * factor[:, None]


class VagramLearner(Stateless):
    """Value-gradient weights for each transition and state dimension.

    Uniform, and not ready, while there is no value function or nothing was collected on policy.
    """

    def __init__(self, config: VagramConfig) -> None:
        self.config = config

    def weigh(self, context: FitContext) -> Weighting:
        replay = context.replay
        if context.value_gradient is None or context.on_policy_steps == 0:
            return uniform(replay, ready=False)
        scale = Scaling.of((), (replay.next_obs, replay.obs)).std  # as the model's targets
        raw = value_gradient_weights(replay.next_obs, scale, context.value_gradient)
        per_dim, degenerate = normalise(clip_rows(raw, self.config.clip_quantile).flatten())
        per_dim, notices = per_dim.view_as(raw), (DEGENERATE,) if degenerate else ()
        weights = per_dim.mean(1)
        return Weighting(weights, per_dim, ready=not degenerate, notices=notices)
