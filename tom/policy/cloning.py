"""Behaviour cloning: estimate the policy behind recorded transitions."""

from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import relu

from tom.data.transitions import TensorTransitions
from tom.nn.mlp import StackedMLP

HIDDEN = 64
STEPS = 200  # few, because more steps would fit the noise of a trajectory's few dozen rows
LR = 3e-3
WEIGHT_DECAY = 1e-3
MIN_STD = 1e-2


@dataclass(frozen=True)
class ClonedPolicy:
    """A Gaussian around a network's mean, clipped at the bounds: a `tom.learners.base.Policy`."""

    net: StackedMLP
    centre: Tensor  # (O,) mean and
    spread: Tensor  # (O,) standard deviation of the cloned observations
    std: Tensor  # (A,) of the actions around the mean

    @torch.no_grad()
    def __call__(self, obs: Tensor, n: int, generator: torch.Generator) -> Tensor:
        """n sampled actions for obs (B, O): (n, B, A) in [-1, 1]."""
        mean = self.mean(obs)
        noise = torch.randn(n, *mean.shape, generator=generator)
        return (mean + self.std * noise).clamp(-1, 1)

    def mean(self, obs: Tensor) -> Tensor:
        """Mean actions (B, A), before clipping."""
        return self.net(((obs - self.centre) / self.spread)[None])[0]


def clone(rows: TensorTransitions, generator: torch.Generator) -> ClonedPolicy:
    """The policy that maximises the likelihood of `rows`' actions, with a constant std."""
    sizes = [rows.obs.shape[1], HIDDEN, HIDDEN, rows.action.shape[1]]
    net = StackedMLP(1, sizes, relu, generator)
    spread, centre = torch.std_mean(rows.obs, 0, correction=0)
    policy = ClonedPolicy(net, centre, spread.clamp(min=1e-6), torch.zeros(sizes[-1]))
    optimiser = torch.optim.AdamW(net.parameters(), LR, weight_decay=WEIGHT_DECAY)
    for _ in range(STEPS):
        optimiser.zero_grad()
        (policy.mean(rows.obs) - rows.action).square().mean().backward()
        optimiser.step()
    with torch.no_grad():
        residual = (policy.mean(rows.obs) - rows.action).square().mean(0).sqrt()
    return ClonedPolicy(net, centre, policy.spread, residual.clamp(min=MIN_STD))
