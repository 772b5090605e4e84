"""Mixture density network (Bishop 1994): an independent Gaussian mixture for each dimension."""

from math import log

import torch
from torch import Tensor

from tom.config import ModelConfig
from tom.dynamics.neural import NeuralDynamics, soft_bound

LOG_VAR_MIN, LOG_VAR_MAX = -12.0, 2.0  # of z-scored targets


class Mdn(NeuralDynamics):
    """p(y_d | x) = sum_k softmax(l_d)_k N(y_d; mean_dk, exp(log_var_dk)), K components."""

    def __init__(
        self, obs_dim: int, action_dim: int, config: ModelConfig, generator: torch.Generator
    ) -> None:
        super().__init__(obs_dim, action_dim, 3 * config.components, 1, config, generator)

    def _split_output(self, output: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Raw output -> log mixture weights, means, log variances, each (E, B, D, K)."""
        logits, mean, raw = output.unflatten(-1, (3, self.targets, -1)).unbind(-3)
        return logits.log_softmax(-1), mean, soft_bound(raw, LOG_VAR_MIN, LOG_VAR_MAX)

    def loss_per_dim(self, output: Tensor, target: Tensor) -> Tensor:
        """Negative log-likelihood of each dimension, by log-sum-exp."""
        log_mix, mean, log_var = self._split_output(output)
        square = (target.unsqueeze(-1) - mean).square() * (-log_var).exp()
        joint = log_mix - 0.5 * (square + log_var + log(2 * torch.pi))
        return -joint.logsumexp(-1)

    def mean(self, output: Tensor) -> Tensor:
        log_mix, mean, _ = self._split_output(output)
        return (log_mix.exp() * mean).sum(-1)

    def draw(self, output: Tensor, generator: torch.Generator) -> Tensor:
        """A component by inverse distribution function, then a normal draw from it."""
        log_mix, mean, log_var = self._split_output(output)
        u = torch.rand(*mean.shape[:-1], 1, generator=generator)
        component = (log_mix.exp().cumsum(-1) < u).sum(-1, keepdim=True)
        component = component.clamp(max=mean.shape[-1] - 1)
        chosen_mean = mean.gather(-1, component).squeeze(-1)
        chosen_std = (0.5 * log_var.gather(-1, component).squeeze(-1)).exp()
        return chosen_mean + chosen_std * torch.randn(*chosen_mean.shape, generator=generator)
