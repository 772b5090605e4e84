"""The base of the neural dynamics models: E networks, z-scored inputs and targets.

A model is a stack of E networks over inputs (obs, action) and targets (reward, next_obs - obs).
Subclasses define the distribution and its loss (`mdn`, `ensemble`); `fitting` defines the fit.
"""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import silu, softplus

from tom.config import ModelConfig
from tom.data.sampling import uniform_indices
from tom.data.scaling import Scaling
from tom.data.transitions import TensorTransitions
from tom.nn.adam import Adam
from tom.nn.backprop import forward_trace, gradients
from tom.nn.mlp import StackedMLP


def soft_bound(x: Tensor, low: Tensor | float, high: Tensor | float) -> Tensor:
    """x bounded smoothly from both sides (Chua et al. 2018)."""
    x = high - softplus(high - x)
    return low + softplus(x - low)


class NeuralDynamics:
    """E stacked networks and a gradient step; subclasses define the meaning of the outputs."""

    def __init__(
        self,
        obs_dim: int,
        action_dim: int,
        outputs_per_dim: int,
        ensemble: int,
        config: ModelConfig,
        generator: torch.Generator,
    ) -> None:
        self.config = config
        self.obs_dim = obs_dim
        self.targets = 1 + obs_dim  # reward first
        self.ensemble = ensemble
        hidden = [config.hidden] * config.layers
        sizes = [obs_dim + action_dim, *hidden, self.targets * outputs_per_dim]
        self.net = StackedMLP(ensemble, sizes, silu, generator).requires_grad_(False)
        self.input_scaling = Scaling.identity(obs_dim + action_dim, generator.device)
        self.target_scaling = Scaling.identity(self.targets, generator.device)
        self.elites = torch.arange(min(config.elites, ensemble), device=generator.device)
        self.optimiser = Adam(self.parameters(), config.lr, self.weight_decay())

    def parameters(self) -> list[Tensor]:
        """All learnt tensors: the networks' first, then the extra ones."""
        return [*self.net.tensors(), *self.extra_parameters()]

    # Defined by subclasses

    def loss_per_dim(self, output: Tensor, target: Tensor) -> Tensor:
        """Loss of each target dimension, (E, B, 1 + O), from raw outputs and z-scored targets."""
        raise NotImplementedError

    def mean(self, output: Tensor) -> Tensor:
        """Mean of the z-scored target, (E, B, 1 + O)."""
        raise NotImplementedError

    def draw(self, output: Tensor, generator: torch.Generator) -> Tensor:
        """A draw of the z-scored target, (E, B, 1 + O)."""
        raise NotImplementedError

    def regulariser(self) -> Tensor | float:
        """A term added to the training loss."""
        return 0.0

    def extra_parameters(self) -> list[Tensor]:
        """Learnt tensors outside the networks, with a leading E."""
        return []

    def weight_decay(self) -> float | list[float]:
        """L2 coefficient of all `parameters()`, or one for each."""
        return 0.0

    def uses_dim_weights(self, first_round: bool) -> bool:
        """Whether per-dimension weights scale the loss, in the first round of a fit or later."""
        return True

    # Fitting

    @property
    def device(self) -> torch.device:
        return self.elites.device

    def step(self, x: Tensor, y: Tensor, *scales: Tensor) -> Tensor:
        """A gradient step on z-scored minibatches (E, B, ...); returns each network's loss, (E,).

        `scales` multiply the loss of each dimension, (E, B, 1 + O) or (E, B, 1), in this order.
        """
        trace = forward_trace(self.net, x)
        loss, grad, extra = self.loss_gradient(trace.output, y, scales)
        self.optimiser.step([*gradients(self.net, trace, grad), *extra])
        return loss

    def loss_gradient(
        self, output: Tensor, target: Tensor, scales: Sequence[Tensor]
    ) -> tuple[Tensor, Tensor, list[Tensor]]:
        """Each network's mean loss (E,); gradients of their sum for the output and the extras."""
        output, extra = output.requires_grad_(), self.extra_parameters()
        with torch.enable_grad():
            loss = self.loss_per_dim(output, target)
            for scale in scales:
                loss = loss * scale
            means = loss.mean((1, 2))
            total = means.sum() + self.regulariser()
        grad, *extra_gradients = torch.autograd.grad(total, [output, *extra])
        return means.detach(), grad, extra_gradients

    # Network inputs and targets

    def inputs(self, rows: TensorTransitions) -> Tensor:
        """z-scored (obs, action), (..., O + A)."""
        return self.input_scaling(torch.cat([rows.obs, rows.action], -1))

    def scaled_targets(self, rows: TensorTransitions) -> Tensor:
        """z-scored (reward, change of obs), (..., 1 + O)."""
        change = torch.cat([rows.reward.unsqueeze(-1), rows.next_obs - rows.obs], -1)
        return self.target_scaling(change)

    def fit_scales(self, data: TensorTransitions, rows: Tensor) -> None:
        """Scale inputs and targets by the moments of these rows (n,) of the data."""
        self.input_scaling = Scaling.of((data.obs, data.action), rows=rows)
        change = data.next_obs, data.obs
        self.target_scaling = Scaling.of((data.reward.unsqueeze(1),), change, rows)

    # Predicting

    def outputs(self, x: Tensor) -> Tensor:
        """Every network's raw output at x (B, D): (E, B, ...)."""
        return self.net(x.unsqueeze(0).expand(self.ensemble, -1, -1))

    @torch.no_grad()
    def sample(
        self, obs: Tensor, action: Tensor, generator: torch.Generator
    ) -> tuple[Tensor, Tensor]:
        """Draw (reward (B,), next_obs (B, O)); each row from one elite network at random."""
        x = self.input_scaling(torch.cat([obs, action], -1))
        drawn = self.draw(self.outputs(x), generator)
        pick = uniform_indices(len(self.elites), len(obs), generator)
        if self.ensemble == 1:
            return self._unscale(obs, drawn[0])
        z = drawn[self.elites[pick], torch.arange(len(obs), device=obs.device)]
        return self._unscale(obs, z)

    @torch.no_grad()
    def predict(self, obs: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """The elites' mean (reward (B,), next_obs (B, O))."""
        x = self.input_scaling(torch.cat([obs, action], -1))
        return self._unscale(obs, self.mean(self.outputs(x)[self.elites]).mean(0))

    @torch.no_grad()
    def nll(self, rows: TensorTransitions) -> Tensor | None:
        """The elites' mean loss of each target dimension, (N, 1 + O); None without a likelihood."""
        losses = self.loss_per_dim(self.outputs(self.inputs(rows)), self.scaled_targets(rows))
        return losses[self.elites].mean(0)

    def _unscale(self, obs: Tensor, z: Tensor) -> tuple[Tensor, Tensor]:
        y = self.target_scaling.inverse(z)
        return y[:, 0], obs + y[:, 1:]

    # State

    def state_dict(self) -> dict[str, Any]:
        scales = (self.input_scaling, self.target_scaling)
        return {
            "net": self.net.own_state(),
            "extra": [p.detach().clone() for p in self.extra_parameters()],
            "optimiser": self.optimiser.state_dict(),
            "scales": [t.clone() for s in scales for t in (s.mean, s.std)],
            "elites": self.elites.clone(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.load_parameters(state)
        self.optimiser.load_state_dict(state["optimiser"])

    def load_parameters(self, state: dict[str, Any]) -> None:
        self.net.load_state_dict(state["net"])
        with torch.no_grad():
            for parameter, value in zip(self.extra_parameters(), state["extra"], strict=True):
                parameter.copy_(value)
        scales = state["scales"]
        self.input_scaling = Scaling(*scales[:2]).to(self.device)
        self.target_scaling = Scaling(*scales[2:]).to(self.device)
        self.elites = state["elites"].to(self.device)
