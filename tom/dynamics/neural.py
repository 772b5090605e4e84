"""The fit shared by the neural dynamics models: E networks, z-scored data, early stopping.

A model is a stack of E networks over inputs (obs, action) and targets (reward, next_obs - obs).
What it predicts, and with which loss, is its subclass's affair (`mdn`, `ensemble`).
"""

from collections.abc import Iterator
from copy import deepcopy
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import silu, softplus

from tom.config import ModelConfig
from tom.data.sampling import WeightedSampler, uniform_indices
from tom.data.transitions import TensorTransitions
from tom.dynamics.base import FitReport
from tom.nn import StackedMLP

MIN_STD = 1e-6  # a constant dimension is centred and left unscaled


def soft_bound(x: Tensor, low: Tensor | float, high: Tensor | float) -> Tensor:
    """x pressed smoothly between two bounds (Chua et al. 2018)."""
    x = high - softplus(high - x)
    return low + softplus(x - low)


class Standardiser:
    """Mean and standard deviation of each column, (D,); constant columns have scale 1."""

    def __init__(self, dim: int) -> None:
        self.mean = torch.zeros(dim)
        self.std = torch.ones(dim)

    def fit(self, x: Tensor) -> None:
        std, mean = torch.std_mean(x, 0, correction=0)
        self.mean, self.std = mean, torch.where(std < MIN_STD, torch.ones_like(std), std)

    def forward(self, x: Tensor) -> Tensor:
        return (x - self.mean) / self.std

    def inverse(self, z: Tensor) -> Tensor:
        return z * self.std + self.mean


class NeuralDynamics:
    """E stacked networks and the weighted fit; subclasses say what their outputs mean."""

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
        self.targets = 1 + obs_dim  # reward first
        self.ensemble = ensemble
        hidden = [config.hidden] * config.layers
        sizes = [obs_dim + action_dim, *hidden, self.targets * outputs_per_dim]
        self.net = StackedMLP(ensemble, sizes, silu, [generator])
        self.optimiser = torch.optim.Adam(self._parameter_groups(), lr=config.lr, fused=True)
        self.input_scale = Standardiser(obs_dim + action_dim)
        self.target_scale = Standardiser(self.targets)
        self.elites = torch.arange(min(config.elites, ensemble))

    # What a subclass decides

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

    def _parameter_groups(self) -> list[dict[str, Any]]:
        return [{"params": list(self.net.parameters())}]

    def extra_parameters(self) -> list[Tensor]:
        """Learnt tensors outside the networks."""
        return []

    # Fitting

    def fit(
        self,
        data: TensorTransitions,
        weights: Tensor,
        per_dim: Tensor | None,
        generator: torch.Generator,
    ) -> FitReport:
        """Weighted maximum likelihood (eq. 17) with early stopping; the best weights are kept.

        `weights` (N,) have mean 1 and are clipped at `config.weight_clip`. They draw the
        minibatches or scale the loss, never both. A round is `batches_per_round` minibatches;
        the fit stops after `patience` rounds without a relative gain of `min_gain` in the
        weighted holdout loss.
        """
        train, held = self._split(len(data), generator)
        x, y = self._inputs(data.obs, data.action), self._targets(data)
        self.input_scale.fit(x[train])
        self.target_scale.fit(y[train])
        x, y = self.input_scale.forward(x), self.target_scale.forward(y)
        weights = weights.clamp(max=self.config.weight_clip)
        dim_weights = None if per_dim is None else _with_reward_column(per_dim)
        best = _Best(self, self.config.min_gain)
        best.offer(self._holdout(x[held], y[held], weights[held], _rows(dim_weights, held)))
        train_loss, rounds, idle = float("nan"), 0, 0
        while rounds < self.config.rounds and idle < self.config.patience:
            batches = self._batches(train, weights[train], generator)
            train_loss = self._round(x, y, weights, dim_weights, batches, first=rounds == 0)
            losses = self._holdout(x[held], y[held], weights[held], _rows(dim_weights, held))
            idle = 0 if best.offer(losses) else idle + 1
            rounds += 1
        best.restore()
        self.elites = best.losses.argsort()[: len(self.elites)]
        return FitReport(
            {
                "model/train_nll": train_loss,
                "model/holdout_nll": float(best.losses[self.elites].mean()),
                "model/rounds": float(rounds),
                **self._holdout_metrics(x[held], y[held]),
            }
        )

    def _split(self, n: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        held = min(int(n * self.config.holdout), self.config.holdout_max)
        order = torch.randperm(n, generator=generator)
        return order[held:], order[: max(held, 1)]

    def _batches(
        self, train: Tensor, weights: Tensor, generator: torch.Generator
    ) -> Iterator[Tensor]:
        """Row indices (E, B) of each minibatch of a round; each network draws its own."""
        count, size = self.config.batches_per_round, self.config.batch_size
        n = count * self.ensemble * size
        if self.config.weights == "sample":
            drawn = WeightedSampler(weights, generator).draw(n)
        else:
            drawn = uniform_indices(len(train), n, generator)
        return iter(train[drawn].view(count, self.ensemble, size))

    def _round(
        self,
        x: Tensor,
        y: Tensor,
        weights: Tensor,
        dim_weights: Tensor | None,
        batches: Iterator[Tensor],
        first: bool,
    ) -> float:
        total, count = torch.zeros(()), 0
        for index in batches:
            loss = self.loss_per_dim(self.net(x[index]), y[index])
            if dim_weights is not None and self._uses_dim_weights(first):
                loss = loss * dim_weights[index]
            if self.config.weights == "scale":
                loss = loss * weights[index].unsqueeze(-1)
            data_loss = loss.mean((1, 2)).sum()
            self.optimiser.zero_grad(set_to_none=True)
            (data_loss + self.regulariser()).backward()
            self.optimiser.step()
            total += data_loss.detach()
            count += self.ensemble
        return float(total) / max(count, 1)

    def _uses_dim_weights(self, first_round: bool) -> bool:
        return True

    @torch.no_grad()
    def _holdout(self, x: Tensor, y: Tensor, weights: Tensor, dim_weights: Tensor | None) -> Tensor:
        """Weighted holdout loss of each network, (E,)."""
        loss = self.loss_per_dim(self._outputs(x), y)
        if dim_weights is not None:
            loss = loss * dim_weights
        mass = weights.sum()
        weights = torch.ones_like(weights) if mass <= 0 else weights / mass * len(weights)
        return (loss.mean(-1) * weights).mean(-1)

    @torch.no_grad()
    def _holdout_metrics(self, x: Tensor, y: Tensor) -> dict[str, float]:
        output = self._outputs(x)[self.elites]
        error = self.mean(output).mean(0) - y
        return {
            "model/holdout_nll_uniform": float(self.loss_per_dim(output, y).mean()),
            "model/holdout_mse": float(error.square().mean()),
        }

    # Predicting

    def _outputs(self, x: Tensor) -> Tensor:
        return self.net(x.unsqueeze(0).expand(self.ensemble, -1, -1))

    def _inputs(self, obs: Tensor, action: Tensor) -> Tensor:
        return torch.cat([obs, action], -1)

    def _targets(self, data: TensorTransitions) -> Tensor:
        return torch.cat([data.reward.unsqueeze(-1), data.next_obs - data.obs], -1)

    @torch.no_grad()
    def sample(
        self, obs: Tensor, action: Tensor, generator: torch.Generator
    ) -> tuple[Tensor, Tensor]:
        """Draw (reward (B,), next_obs (B, O)); each row from one elite network at random."""
        x = self.input_scale.forward(self._inputs(obs, action))
        drawn = self.draw(self._outputs(x), generator)
        pick = uniform_indices(len(self.elites), len(obs), generator)
        z = drawn[self.elites[pick], torch.arange(len(obs))]
        return self._unscale(obs, z)

    @torch.no_grad()
    def predict(self, obs: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """The elites' mean (reward (B,), next_obs (B, O))."""
        x = self.input_scale.forward(self._inputs(obs, action))
        return self._unscale(obs, self.mean(self._outputs(x)[self.elites]).mean(0))

    def _unscale(self, obs: Tensor, z: Tensor) -> tuple[Tensor, Tensor]:
        y = self.target_scale.inverse(z)
        return y[:, 0], obs + y[:, 1:]

    # State

    def state_dict(self) -> dict[str, Any]:
        scales = (self.input_scale, self.target_scale)
        return {
            "net": self.net.state_dict(),
            "extra": [p.detach().clone() for p in self.extra_parameters()],
            "optimiser": self.optimiser.state_dict(),
            "scales": [t.clone() for s in scales for t in (s.mean, s.std)],
            "elites": self.elites.clone(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.net.load_state_dict(state["net"])
        with torch.no_grad():
            for parameter, value in zip(self.extra_parameters(), state["extra"], strict=True):
                parameter.copy_(value)
        self.optimiser.load_state_dict(deepcopy(state["optimiser"]))
        self.input_scale.mean, self.input_scale.std = state["scales"][:2]
        self.target_scale.mean, self.target_scale.std = state["scales"][2:]
        self.elites = state["elites"]


class _Best:
    """The best networks of a fit so far, each network by its own holdout loss."""

    def __init__(self, model: NeuralDynamics, min_gain: float) -> None:
        self._parameters = list(model.net.parameters())
        self._min_gain = min_gain
        self.losses = torch.full((model.ensemble,), float("inf"))
        self._kept = [p.detach().clone() for p in self._parameters]

    def offer(self, losses: Tensor) -> bool:
        """Keep every network that improved; True if one gained at least `min_gain`."""
        better = losses < self.losses
        gain = torch.where(
            self.losses.isinf(), torch.ones_like(losses), self._relative_gain(losses)
        )
        for kept, parameter in zip(self._kept, self._parameters, strict=True):
            kept[better] = parameter.detach()[better]
        self.losses = torch.where(better, losses, self.losses)
        return bool((better & (gain > self._min_gain)).any())

    def _relative_gain(self, losses: Tensor) -> Tensor:
        return (self.losses - losses) / self.losses.abs().clamp(min=1e-8)

    @torch.no_grad()
    def restore(self) -> None:
        for kept, parameter in zip(self._kept, self._parameters, strict=True):
            parameter.copy_(kept)


def _with_reward_column(per_dim: Tensor) -> Tensor:
    """Per-dimension weights (N, 1 + O): the reward, first, always counts 1."""
    return torch.cat([torch.ones(len(per_dim), 1), per_dim], -1)


def _rows(table: Tensor | None, index: Tensor) -> Tensor | None:
    return None if table is None else table[index]
