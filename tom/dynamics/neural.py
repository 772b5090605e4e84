"""The base of the neural dynamics models: E networks, z-scored inputs and targets.

A model is a stack of E networks over inputs (obs, action) and targets (reward, next_obs - obs).
Subclasses define the distribution and its loss (`networks`).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import silu, softplus

from tom.config import ModelConfig
from tom.data.sampling import WeightedSampler, block_size, uniform_indices
from tom.data.scaling import Scaling
from tom.data.transitions import TensorTransitions
from tom.dynamics.base import FitReport
from tom.nn.mlp import StackedMLP
from tom.nn.trained import Adam

BLOCK, GPU_BLOCK = 10, 100  # minibatches gathered at once
UNWEIGHTED = (
    "fit-unweighted",
    "all of the weight lies on rows that this fit of the model holds out: it uses uniform weights",
)
"""kind of the notice about a fit whose training rows have no weight"""


def soft_bound(x: Tensor, low: Tensor | float, high: Tensor | float) -> Tensor:
    """x bounded smoothly from both sides (Chua et al. 2018)."""
    x = high - softplus(high - x)
    return low + softplus(x - low)


class NeuralDynamics:
    """E stacked networks and their fit; subclasses define the meaning of the outputs."""

    plain_first_round = False
    """whether per-dimension weights do not count in the first round of a fit"""

    def __init__(
        self, obs_dim: int, action_dim: int, config: ModelConfig, generator: torch.Generator
    ) -> None:
        self.config = config
        self.obs_dim = obs_dim
        self.targets = 1 + obs_dim  # reward first
        outputs_per_dim, self.ensemble = self.outputs_and_networks()
        hidden = [config.hidden] * config.layers
        sizes = [obs_dim + action_dim, *hidden, self.targets * outputs_per_dim]
        self.net = StackedMLP(self.ensemble, sizes, silu, generator)
        self.input_scaling = Scaling.identity(obs_dim + action_dim, generator.device)
        self.target_scaling = Scaling.identity(self.targets, generator.device)
        self.elites = torch.arange(min(config.elites, self.ensemble), device=generator.device)
        self.optimiser = Adam(self.parameters(), config.lr, self.weight_decay())

    def parameters(self) -> list[Tensor]:
        """All learnt tensors: the networks' first, then the extra ones."""
        return [*self.net.tensors(), *self.extra_parameters()]

    # Defined by subclasses

    def outputs_and_networks(self) -> tuple[int, int]:
        """Raw outputs for each target dimension, and the number of networks E."""
        raise NotImplementedError

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

    # Fitting

    @torch.no_grad()
    def fit(
        self,
        data: TensorTransitions,
        weights: Tensor,
        per_dim: Tensor | None,
        generator: torch.Generator,
    ) -> FitReport:
        """Weighted maximum likelihood (eq. 18) with early stopping; the best networks are kept.

        `weights` (N,) have mean 1, those of single dimensions are (N, O). They draw the minibatches
        or scale the loss, never both. A round is `batches_per_round` minibatches. A gain is a
        weighted holdout loss that is `min_gain` (relative) below that of the last gain; the first
        round counts as one. The fit stops after more than `patience` rounds in a row without a
        gain. If no row to train on has any weight, all have the same, and a notice says so.
        """
        config = self.config
        notices: tuple[tuple[str, str], ...] = ()
        train, held = split(len(data), config, generator)
        if not bool(weights[train].any()):
            weights, notices = torch.ones_like(weights), (UNWEIGHTED,)
        if per_dim is not None:  # the reward, first, always counts 1
            per_dim = torch.cat([torch.ones_like(per_dim[:, :1]), per_dim], -1)
        self._fit_scales(data, train)
        sampler = WeightedSampler(weights[train], generator) if config.weights == "sample" else None

        def minibatches(plain: bool) -> Iterator[Iterable[Tensor]]:
            """The arguments of `step` for a round; each network draws its own rows."""
            shape = config.batches_per_round, self.ensemble, config.batch_size
            n = shape[0] * shape[1] * shape[2]
            drawn = sampler.draw(n) if sampler else uniform_indices(len(train), n, generator)
            for index in train[drawn].view(shape).split(block_size(self.device, BLOCK, GPU_BLOCK)):
                at = index.flatten()
                rows = data[at]
                parts = [self.inputs(rows), self.scaled_targets(rows)]
                parts += [] if per_dim is None or plain else [per_dim[at]]
                parts += [] if sampler else [weights[at].unsqueeze(-1)]
                yield from zip(*(part.view(*index.shape, -1) for part in parts), strict=True)

        x, y = self.inputs(data[held]), self.scaled_targets(data[held])
        judged = x, y, weights[held], None if per_dim is None else per_dim[held]
        best = _Best(self, config.min_gain)
        best.keep(holdout_loss(self, *judged))
        rounds, idle, loss = 0, 0, torch.tensor(float("nan"))
        while rounds < config.rounds and idle <= config.patience:
            loss = torch.zeros((), device=self.device)
            for batch in minibatches(self.plain_first_round and rounds == 0):
                loss += self.step(*batch).sum()
            idle = 0 if best.update(holdout_loss(self, *judged)) else idle + 1
            rounds += 1
        best.restore()
        self.elites = best.losses.argsort()[: len(self.elites)]
        metrics = {
            "model/train_nll": float(loss) / (config.batches_per_round * self.ensemble),
            "model/holdout_nll": float(best.losses[self.elites].mean()),
            "model/rounds": float(rounds),
            **self._unweighted_metrics(x, y),
        }
        return FitReport(metrics, notices)

    def _unweighted_metrics(self, x: Tensor, y: Tensor) -> dict[str, float]:
        """Loss and squared error of the elites on z-scored inputs and targets."""
        output, elites = self.outputs(x), self.elites
        error = self.mean(output)[elites].mean(0) - y
        return {
            "model/holdout_nll_uniform": float(self.loss_per_dim(output, y)[elites].mean()),
            "model/holdout_mse": float(error.square().mean()),
        }

    @property
    def device(self) -> torch.device:
        return self.elites.device

    @torch.enable_grad()
    def step(self, x: Tensor, y: Tensor, *scales: Tensor) -> Tensor:
        """A gradient step on z-scored minibatches (E, B, ...); returns each network's loss, (E,).

        `scales` multiply the loss of each dimension, (E, B, 1 + O) or (E, B, 1), in this order.
        """
        loss = self.loss_per_dim(self.net(x), y)
        for scale in scales:
            loss = loss * scale
        means = loss.mean((1, 2))
        total = means.sum() + self.regulariser()
        self.optimiser.step(torch.autograd.grad(total, self.parameters()))
        return means.detach()

    # Network inputs and targets

    def inputs(self, rows: TensorTransitions) -> Tensor:
        """z-scored (obs, action), (..., O + A)."""
        return self.input_scaling(torch.cat([rows.obs, rows.action], -1))

    def scaled_targets(self, rows: TensorTransitions) -> Tensor:
        """z-scored (reward, change of obs), (..., 1 + O)."""
        change = torch.cat([rows.reward.unsqueeze(-1), rows.next_obs - rows.obs], -1)
        return self.target_scaling(change)

    def _fit_scales(self, data: TensorTransitions, rows: Tensor) -> None:
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
    def hidden(self, obs: Tensor, action: Tensor) -> Tensor:
        """The last hidden layer of the best network for obs (B, O), action (B, A): (B, H)."""
        x = self.input_scaling(torch.cat([obs, action], -1))
        return self.net.hidden(int(self.elites[0]), x)

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


def holdout_loss(
    model: NeuralDynamics, x: Tensor, y: Tensor, weights: Tensor, dims: Tensor | None
) -> Tensor:
    """Weighted holdout loss of each network, (E,)."""
    loss = model.loss_per_dim(model.outputs(x), y)
    if dims is not None:
        loss = loss * dims
    mass = weights.sum()
    weights = torch.where(mass <= 0, torch.ones_like(weights), weights / mass * len(weights))
    return (loss.mean(-1) * weights).mean(-1)


def split(n: int, config: ModelConfig, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Row numbers to train on, and those held out."""
    held = min(int(n * config.holdout), config.holdout_max)
    order = torch.randperm(n, generator=generator, device=generator.device)
    return order[held:], order[: max(held, 1)]


class _Best:
    """The best networks of a fit so far, each network by its own holdout loss."""

    def __init__(self, model: NeuralDynamics, min_gain: float) -> None:
        self._parameters = model.parameters()
        self._min_gain = min_gain
        self._kept = [p.clone() for p in self._parameters]
        self.losses = self._kept[0].new_full((model.ensemble,), float("inf"))
        self._last_gain = self.losses.clone()

    def update(self, losses: Tensor) -> bool:
        """Keep every network that improved; True if one gained more than `min_gain`.

        Many small gains add up to one: it is counted from the loss of the last gain.
        """
        self.keep(losses)
        gain = (self._last_gain - losses) / self._last_gain.abs().clamp(min=1e-8)
        gained = losses.isfinite() & (self._last_gain.isinf() | (gain > self._min_gain))
        self._last_gain = torch.where(gained, losses, self._last_gain)
        return bool(gained.any())

    def keep(self, losses: Tensor) -> None:
        """Keep every network that improved."""
        better = losses < self.losses
        for kept, parameter in zip(self._kept, self._parameters, strict=True):
            torch.where(better.view(-1, 1, 1), parameter, kept, out=kept)
        self.losses = torch.where(better, losses, self.losses)

    def restore(self) -> None:
        for kept, parameter in zip(self._kept, self._parameters, strict=True):
            parameter.copy_(kept)
