"""The interface of a dynamics model: a weighted fit, samples and the mean prediction."""

from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

from tom.data.transitions import TensorTransitions


class FitReport(NamedTuple):
    """The result of a fit: metrics by path, and (kind, message) notices for the run's record."""

    metrics: dict[str, float]
    notices: tuple[tuple[str, str], ...] = ()


class Predictor(Protocol):
    """A dynamics model as far as it predicts: its mean."""

    def predict(self, obs: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """The mean (reward (B,), next_obs (B, O)) for obs (B, O) and action (B, A)."""
        ...


class Sampled(Protocol):
    """A dynamics model as far as a rollout needs it."""

    def sample(
        self, obs: Tensor, action: Tensor, generator: torch.Generator
    ) -> tuple[Tensor, Tensor]:
        """Draw (reward (B,), next_obs (B, O)) for obs (B, O) and action (B, A)."""
        ...


class DynamicsModel(Predictor, Sampled, Protocol):
    """p(reward, next_obs | obs, action), fitted by weighted maximum likelihood."""

    def fit(
        self,
        data: TensorTransitions,
        weights: Tensor,
        per_dim: Tensor | None,
        generator: torch.Generator,
    ) -> FitReport:
        """Fit to N transitions with weights (N,), mean 1, and per-dimension weights (N, O)."""
        ...

    def nll(self, rows: TensorTransitions) -> Tensor | None:
        """Negative log-likelihood of each target dimension of N transitions, (N, 1 + O).

        In the units of `model/train_nll`; None for a model that has no likelihood.
        """
        ...

    def state_dict(self) -> dict[str, Any]: ...

    def load_state_dict(self, state: dict[str, Any]) -> None: ...

    def load_parameters(self, state: dict[str, Any]) -> None:
        """Load only those parts of a `state_dict` that predictions need."""
        ...
