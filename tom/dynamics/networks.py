"""The neural dynamics models: mixture density network, Gaussian ensemble, mean-only ensemble."""

from math import log

import torch
from torch import Tensor

from tom.config import ModelConfig
from tom.data.transitions import TensorTransitions
from tom.dynamics.neural import NeuralDynamics, soft_bound

LOG_VAR_MIN, LOG_VAR_MAX = -12.0, 2.0  # of z-scored targets
WEIGHT_DECAY = (2.5e-5, 5e-5, 7.5e-5, 7.5e-5, 1e-4)  # by layer (Janner et al. 2019)
BOUND_PENALTY = 0.01


class Mdn(NeuralDynamics):
    """Mixture density network (Bishop 1994), an independent mixture for each dimension.

    p(y_d | x) = sum_k softmax(l_d)_k N(y_d; mean_dk, exp(log_var_dk)), K components.
    """

    def outputs_and_networks(self) -> tuple[int, int]:
        return 3 * self.config.components, 1

    # Components come before dimensions, (E, B, K, D), so that sums over K run over whole vectors.

    def _split_output(self, output: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Raw output -> mixture logits, means, log variances, each (E, B, K, D)."""
        logits, mean, raw = output.unflatten(-1, (3, -1, self.targets)).unbind(-3)
        return logits, mean, soft_bound(raw, LOG_VAR_MIN, LOG_VAR_MAX)

    def loss_per_dim(self, output: Tensor, target: Tensor) -> Tensor:
        """Negative log-likelihood of each dimension, by log-sum-exp."""
        logits, mean, log_var = self._split_output(output)
        square = (target.unsqueeze(-2) - mean).square() * (-log_var).exp()
        joint = logits - 0.5 * (square + log_var)
        return logits.logsumexp(-2) - joint.logsumexp(-2) + 0.5 * log(2 * torch.pi)

    def mean(self, output: Tensor) -> Tensor:
        logits, mean, _ = self._split_output(output)
        return (logits.softmax(-2) * mean).sum(-2)

    def draw(self, output: Tensor, generator: torch.Generator) -> Tensor:
        """A component by inverse distribution function, then a normal draw from it."""
        logits, means, raws = output.chunk(3, -1)  # (E, B, K D) each
        shape = (*output.shape[:-1], self.targets)
        u = torch.rand(*shape, generator=generator, device=generator.device)
        component = pick_component(logits.unflatten(-1, (-1, self.targets)), u)
        at = component * self.targets + torch.arange(self.targets, device=output.device)
        log_var = soft_bound(raws.gather(-1, at), LOG_VAR_MIN, LOG_VAR_MAX)
        noise = torch.randn(*shape, generator=generator, device=generator.device)
        return means.gather(-1, at) + (0.5 * log_var).exp() * noise


def pick_component(logits: Tensor, u: Tensor) -> Tensor:
    """The component of each mixture (E, B, D) for `u` (E, B, D), uniform on [0, 1).

    It is the first whose cumulative probability reaches u; `logits` are (E, B, K, D).
    """
    ahead = logits.permute(2, 3, 0, 1).contiguous()  # (K, D, E, B): whole vectors at every step
    ahead = ahead.sub_(ahead.amax(0)).exp_().cumsum(0)
    return (ahead[:-1] < u.permute(2, 0, 1) * ahead[-1]).sum(0).permute(1, 2, 0)


class _Ensemble(NeuralDynamics):
    def weight_decay(self) -> list[float]:
        """One coefficient per layer; the last layer takes the last value, extra parameters none."""
        layers = len(self.net.layers)
        decays = [*WEIGHT_DECAY[: layers - 1], WEIGHT_DECAY[-1]]
        decays = [WEIGHT_DECAY[-2]] * (layers - len(decays)) + decays
        return [*decays, *decays, *(0.0 for _ in self.extra_parameters())]


class GaussianEnsemble(_Ensemble):
    """E Gaussian networks with learnt bounds of the log variance (Janner et al. 2019)."""

    def __init__(
        self, obs_dim: int, action_dim: int, config: ModelConfig, generator: torch.Generator
    ) -> None:
        bound = torch.ones(config.members, 1, 1 + obs_dim, device=generator.device)
        self.max_log_var = (0.5 * bound).requires_grad_()
        self.min_log_var = (-10.0 * bound).requires_grad_()
        super().__init__(obs_dim, action_dim, config, generator)

    def outputs_and_networks(self) -> tuple[int, int]:
        return 2, self.config.members

    def extra_parameters(self) -> list[Tensor]:
        return [self.max_log_var, self.min_log_var]

    def _log_var(self, raw: Tensor) -> Tensor:
        return soft_bound(raw, self.min_log_var, self.max_log_var)

    def loss_per_dim(self, output: Tensor, target: Tensor) -> Tensor:
        """Gaussian negative log-likelihood without its constant, as Janner's."""
        mean, raw = output.chunk(2, -1)
        log_var = self._log_var(raw)
        return (target - mean).square() * (-log_var).exp() + log_var

    def regulariser(self) -> Tensor:
        return BOUND_PENALTY * (self.max_log_var.sum() - self.min_log_var.sum())

    def mean(self, output: Tensor) -> Tensor:
        return output.chunk(2, -1)[0]

    def draw(self, output: Tensor, generator: torch.Generator) -> Tensor:
        mean, raw = output.chunk(2, -1)
        std = (0.5 * self._log_var(raw)).exp()
        return mean + std * torch.randn(*mean.shape, generator=generator, device=mean.device)


class MeanEnsemble(_Ensemble):
    """E networks that predict the mean only, with VaGram's squared loss.

    VaGram's is sum_d (dV/ds'_d)^2 (pred_d - s'_d)^2 + (pred_r - r)^2. With z-scored targets the
    weight of dimension d is (sigma_d dV/ds'_d)^2. The learner's per-dimension weights are
    proportional to it but scaled to mean 1, and the z-scored error of the reward has weight 1. So
    the balance of state and reward differs from VaGram's. The first round is plain MSE.
    """

    plain_first_round = True

    def outputs_and_networks(self) -> tuple[int, int]:
        return 1, self.config.members

    def loss_per_dim(self, output: Tensor, target: Tensor) -> Tensor:
        return (output - target).square()

    def nll(self, rows: TensorTransitions) -> None:
        """None: this model predicts no distribution."""

    def mean(self, output: Tensor) -> Tensor:
        return output

    def draw(self, output: Tensor, generator: torch.Generator) -> Tensor:
        return output
