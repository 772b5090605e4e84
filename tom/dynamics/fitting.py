"""The weighted fit of neural dynamics models, one or many in lock-step.

Members of a fleet share the gradient steps and nothing else: each has its own data, weights, random
stream, holdout and stopping time.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import torch
from torch import Tensor

from tom.config import ModelConfig
from tom.data.sampling import WeightedSampler, block_size, uniform_indices
from tom.data.transitions import TensorTransitions
from tom.dynamics.base import FitReport
from tom.dynamics.neural import NeuralDynamics
from tom.nn.graphs import captured_step
from tom.nn.lockstep import Rank, Work, do

BLOCK, GPU_BLOCK = 10, 100  # minibatches gathered at once
UNWEIGHTED = (
    "fit-unweighted",
    "all of the weight lies on rows that this fit of the model holds out: it uses uniform weights",
)
"""kind of the notice about a fit whose training rows have no weight"""

Step = Callable[..., Tensor]
"""(x, y, *scales), (E, B, ...) each -> each network's loss (E,): `NeuralDynamics.step`."""


@dataclass
class Fit(Work):
    """Work that fits a model to N transitions; afterwards `report` is set.

    `weights` are (N,), per-dimension weights (N, O).
    """

    rank: ClassVar[Rank] = Rank.FIT
    subject: NeuralDynamics
    data: TensorTransitions
    weights: Tensor
    per_dim: Tensor | None
    generator: torch.Generator
    report: FitReport = field(init=False)

    @property
    def kind(self) -> Hashable:
        return type(self.subject), self.subject.config, self.subject.targets

    @classmethod
    def do(cls, works: Sequence[Fit], subject: NeuralDynamics) -> None:
        reports = fit(works, captured_step(subject))
        for work, report in zip(works, reports, strict=True):
            work.report = report


class FittedDynamics(NeuralDynamics):
    """Networks and their fit, alone or in lock-step."""

    def fit(
        self,
        data: TensorTransitions,
        weights: Tensor,
        per_dim: Tensor | None,
        generator: torch.Generator,
    ) -> FitReport:
        """Weighted maximum likelihood with early stopping: see this module's `fit`."""
        return do(Fit(self, data, weights, per_dim, generator)).report


@torch.no_grad()
def fit(works: Sequence[Fit], step: Step) -> list[FitReport]:
    """Weighted maximum likelihood (eq. 18) with early stopping; the best networks are kept.

    Weights have mean 1. They draw the minibatches or scale the loss, never both. A round is
    `batches_per_round` minibatches. A gain is a weighted holdout loss that is `min_gain` (relative)
    below that of the last gain; the first round counts as one. A fit stops after more than
    `patience` rounds in a row without a gain. If no row to train on has any weight, all have the
    same, and a notice says so. `step` updates the networks of all works at once;
    their configs are equal.
    """
    members = [_Member(work) for work in works]
    while any(m.goes_on for m in members):
        _round(members, step)
    return [m.report() for m in members]


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


def _round(members: Sequence[_Member], step: Step) -> None:
    count = members[0].config.batches_per_round
    scale_dims = any(m.scales_dims for m in members)
    plans = [m.plan() for m in members]
    device = members[0].weights.device
    losses, size = torch.zeros(len(members), device=device), block_size(device, BLOCK, GPU_BLOCK)
    for first in range(0, count, size):
        block = slice(first, first + size)
        parts = [m.gather(p[block], scale_dims) for m, p in zip(members, plans, strict=True)]
        stacked = [p[0] if len(p) == 1 else torch.cat(p, 1) for p in zip(*parts, strict=True)]
        for batch in zip(*stacked, strict=True):
            losses += step(*batch).view(len(members), -1).sum(1)
    for member, loss in zip(members, losses, strict=True):
        member.end_round(loss)


class _Member:
    """The state of one model's fit."""

    def __init__(self, work: Fit) -> None:
        self.model, self.data, self.generator = work.subject, work.data, work.generator
        self.config = self.model.config
        self.weights = work.weights
        self.per_dim = work.per_dim
        self.train, held = split(len(self.data), self.config, self.generator)
        self._notices: tuple[tuple[str, str], ...] = ()
        if not bool(self.weights[self.train].any()):
            self.weights, self._notices = torch.ones_like(self.weights), (UNWEIGHTED,)
        self.model.fit_scales(self.data, self.train)
        rows = self.data[held]
        self._held = self.model.inputs(rows), self.model.scaled_targets(rows)
        self._held_weights = self.weights[held], self._dims(held)
        self._sampler = None
        if self.config.weights == "sample":
            self._sampler = WeightedSampler(self.weights[self.train], self.generator)
        self._best = _Best(self.model, self.config.min_gain)
        self._best.keep(holdout_loss(self.model, *self._held, *self._held_weights))
        self._rounds = self._idle = 0
        self._train_loss = torch.tensor(float("nan"))
        self._stopped: list[Tensor] = []  # the optimiser's tensors at the stop

    @property
    def goes_on(self) -> bool:
        return self._rounds < self.config.rounds and self._idle <= self.config.patience

    @property
    def scales_dims(self) -> bool:
        """Whether this round's loss weighs dimensions differently."""
        return self.per_dim is not None and self.model.uses_dim_weights(self._rounds == 0)

    def plan(self) -> Tensor:
        """Row numbers (batches of the round, E, B); each network draws its own."""
        shape = self.config.batches_per_round, self.model.ensemble, self.config.batch_size
        if not self.goes_on:  # the shared steps still change it; `report` restores it at the end
            return self.train[:1].expand(shape)
        n = shape[0] * shape[1] * shape[2]
        if self._sampler:
            drawn = self._sampler.draw(n)
        else:
            drawn = uniform_indices(len(self.train), n, self.generator)
        return self.train[drawn].view(shape)

    def gather(self, index: Tensor, scale_dims: bool) -> list[Tensor]:
        """Inputs, targets and the loss's factors of rows (n, E, B), each (n, E, B, ...)."""
        rows = self.data[index.flatten()]
        parts = [self.model.inputs(rows), self.model.scaled_targets(rows)]
        if scale_dims:
            dims = self._dims(index.flatten()) if self.scales_dims else torch.ones_like(parts[1])
            parts.append(torch.ones_like(parts[1]) if dims is None else dims)
        if self.config.weights == "scale":
            parts.append(self.weights[index.flatten()].unsqueeze(-1))
        return [part.view(*index.shape, -1) for part in parts]

    def end_round(self, loss: Tensor) -> None:
        """Keep the networks that improved on the holdout; stop if none has for long enough."""
        if not self.goes_on:
            return
        self._train_loss = loss
        losses = holdout_loss(self.model, *self._held, *self._held_weights)
        self._idle = 0 if self._best.offer(losses) else self._idle + 1
        self._rounds += 1
        if not self.goes_on:
            self._stopped = [x.clone() for x in self.model.optimiser.tensors()]

    def report(self) -> FitReport:
        """Restore the best networks, also if other members' later rounds have changed them."""
        self._best.restore()
        for tensor, kept in zip(self.model.optimiser.tensors(), self._stopped, strict=True):
            tensor.copy_(kept)
        model, (x, y), losses = self.model, self._held, self._best.losses
        model.elites = losses.argsort()[: len(model.elites)]
        steps = self.config.batches_per_round * model.ensemble
        output = model.outputs(x)
        uniform = model.loss_per_dim(output, y)[model.elites].mean()
        error = model.mean(output)[model.elites].mean(0) - y
        return FitReport(
            {
                "model/train_nll": float(self._train_loss) / steps,
                "model/holdout_nll": float(losses[model.elites].mean()),
                "model/rounds": float(self._rounds),
                "model/holdout_nll_uniform": float(uniform),
                "model/holdout_mse": float(error.square().mean()),
            },
            self._notices,
        )

    def _dims(self, index: Tensor) -> Tensor | None:
        """Per-dimension weights of rows, (n, 1 + O): the reward, first, always counts 1."""
        if self.per_dim is None:
            return None
        rows = self.per_dim[index]
        return torch.cat([torch.ones_like(rows[:, :1]), rows], -1)


class _Best:
    """The best networks of a fit so far, each network by its own holdout loss."""

    def __init__(self, model: NeuralDynamics, min_gain: float) -> None:
        self._parameters = model.parameters()
        self._min_gain = min_gain
        self._kept = [p.clone() for p in self._parameters]
        self.losses = self._kept[0].new_full((model.ensemble,), float("inf"))
        self._last_gain = self.losses.clone()

    def offer(self, losses: Tensor) -> bool:
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
