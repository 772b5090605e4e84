"""Linear dynamics, fitted in closed form by weighted least squares."""

from dataclasses import dataclass
from math import log, pi
from typing import Any, Self

import torch
from torch import Tensor

from tom.config import ModelConfig
from tom.data.transitions import TensorTransitions, Transitions
from tom.dynamics.base import FitReport

RIDGE = 1e-8
"""keeps the normal equations solvable if the weighted data does not span the inputs"""
MIN_VARIANCE = 1e-12


def least_squares(inputs: Tensor, targets: Tensor, weights: Tensor) -> Tensor:
    """argmin_W sum_n w_n |y_n - W x_n|^2 for x (N, I), y (N, D): W (D, I) in float64.

    `weights` is (N,), or (N, D) where each dimension of y has its own; their scale is free.
    """
    x, y = inputs.double(), targets.double()
    share = usable(weights).double()
    share = share / share.sum(0)
    share = share[:, None].expand_as(y) if share.ndim == 1 else share  # (N, D)
    gram = torch.einsum("nd,ni,nj->dij", share, x, x)
    gram = gram + RIDGE * torch.eye(x.shape[1], dtype=torch.float64, device=x.device)
    moment = torch.einsum("nd,ni->di", share * y, x)
    return torch.linalg.solve(gram, moment)


def usable(weights: Tensor) -> Tensor:
    """Weights (N,) or (N, D); where a dimension has none at all, every row counts the same."""
    return torch.where(weights.sum(0) > 0, weights, torch.ones_like(weights))


@dataclass(frozen=True)
class LinearModel:
    """The deterministic model s' = W [s, a, 1]; `coefficients` is W, (O, O + A + 1)."""

    coefficients: Tensor

    @classmethod
    def fit(cls, transitions: Transitions, weights: Tensor) -> Self:
        """The weighted least squares fit; `weights` is (N,), or (N, O) for each dimension."""
        data = transitions.torch()
        inputs = affine_inputs(data.obs, data.action)
        return cls(least_squares(inputs, data.next_obs, weights).float())

    def next_obs(self, obs: Tensor, action: Tensor) -> Tensor:
        """Next observations (..., O) after (..., O) observations and (..., A) actions."""
        return affine_inputs(obs, action) @ self.coefficients.T


class LinearDynamics:
    """The linear-Gaussian model [r, s'] = W [s, a, 1] + noise: a `DynamicsModel`."""

    def __init__(
        self, obs_dim: int, action_dim: int, config: ModelConfig, generator: torch.Generator
    ) -> None:
        device = generator.device
        self.coefficients = torch.zeros(1 + obs_dim, obs_dim + action_dim + 1, device=device)
        self.std = torch.ones(1 + obs_dim, device=device)

    def fit(
        self,
        data: TensorTransitions,
        weights: Tensor,
        per_dim: Tensor | None,
        generator: torch.Generator,
    ) -> FitReport:
        """Weighted maximum likelihood in closed form; `per_dim` scales the columns of s'."""
        inputs, targets = affine_inputs(data.obs, data.action), _targets(data)
        by_column = weights[:, None].expand_as(targets)
        if per_dim is not None:
            by_column = by_column * torch.cat([torch.ones_like(per_dim[:, :1]), per_dim], -1)
        by_column = usable(by_column)
        self.coefficients = least_squares(inputs, targets, by_column).float()
        square = (targets - inputs @ self.coefficients.T).square()
        variance = (by_column * square).sum(0) / by_column.sum(0)
        self.std = variance.clamp(min=MIN_VARIANCE).sqrt()
        nll = 0.5 * (log(2 * pi) + self.std.square().log() + 1)
        return FitReport({"model/train_nll": float(nll.mean())})

    def predict(self, obs: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """The mean (reward (B,), next_obs (B, O))."""
        mean = affine_inputs(obs, action) @ self.coefficients.T
        return mean[:, 0], mean[:, 1:]

    def nll(self, rows: TensorTransitions) -> Tensor:
        """-log N(target; mean, std^2) of each column of (reward, next_obs), (N, 1 + O)."""
        mean = affine_inputs(rows.obs, rows.action) @ self.coefficients.T
        square = ((_targets(rows) - mean) / self.std).square()
        return 0.5 * (log(2 * pi) + square) + self.std.log()

    def sample(
        self, obs: Tensor, action: Tensor, generator: torch.Generator
    ) -> tuple[Tensor, Tensor]:
        """A draw of (reward (B,), next_obs (B, O))."""
        mean = affine_inputs(obs, action) @ self.coefficients.T
        noise = torch.randn(mean.shape, generator=generator, device=generator.device)
        drawn = mean + self.std * noise
        return drawn[:, 0], drawn[:, 1:]

    def state_dict(self) -> dict[str, Any]:
        return {"coefficients": self.coefficients.clone(), "std": self.std.clone()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.load_parameters(state)

    def load_parameters(self, state: dict[str, Any]) -> None:
        device = self.std.device
        self.coefficients, self.std = (state[n].to(device) for n in ("coefficients", "std"))


def _targets(rows: TensorTransitions) -> Tensor:
    """[r, s'], (N, 1 + O)."""
    return torch.cat([rows.reward.unsqueeze(-1), rows.next_obs], -1)


def affine_inputs(obs: Tensor, action: Tensor) -> Tensor:
    """[s, a, 1], (..., O + A + 1)."""
    return torch.cat([obs, action, torch.ones_like(obs[..., :1])], -1)
