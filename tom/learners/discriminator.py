"""The discriminator between the policy's transitions and the replay's. Its logit is r.

Trained with label 1 on the policy buffer and 0 on the replay buffer in balanced batches, its
optimal logit is log(p/q), with the policy's distribution p and the replay's q (paper, eq. 26).

If both buffers come from the same environment, p(s'|s, a) = q(s'|s, a) and log p(s, a, s')/q(s, a,
s') is log p(s, a)/q(s, a). A discriminator of (s, a) alone then has the same optimal logit, in a
space of fewer dimensions.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import Literal

import torch
from torch import Tensor
from torch.nn.functional import binary_cross_entropy_with_logits, softplus

from tom.config import TomConfig
from tom.data.sampling import block_size, uniform_indices
from tom.data.scaling import Scaling
from tom.data.transitions import TensorTransitions
from tom.nn.mlp import StackedMLP, rows_at_once
from tom.nn.trained import Average, Trained

CHUNK = 1024  # rows evaluated at once; they stay in the processor's cache
BLOCK, GPU_BLOCK = 32, 100  # minibatches gathered at once

Inputs = Literal["transitions", "state-actions"]


class Discriminator(Trained):
    """A network with two Tanh layers over (s, a, s' - s), D = 2 O + A, or (s, a), D = O + A.

    It maps (1, B, D) to (1, B, 1); `fresh` draws one with new parameters.
    """

    def __init__(
        self, obs_dim: int, action_dim: int, config: TomConfig, generator: torch.Generator
    ) -> None:
        hidden = config.discriminator_hidden
        inputs = (2 if config.discriminator_input == "transitions" else 1) * obs_dim + action_dim
        self.fresh = partial(StackedMLP, 1, [inputs, hidden, hidden, 1], torch.tanh)
        super().__init__(self.fresh(generator), config.discriminator_lr)
        self.config = config

    def step(self, positive: Tensor, negative: Tensor, *mix: Tensor) -> tuple[Tensor, Tensor]:
        """A gradient step on rows (B, D) of both kinds; the loss and the logits (2 B,) before it.

        `mix` (B, 1), uniform on [0, 1), interpolates the points of the gradient penalty.
        """
        logits = self.net(torch.cat((positive, negative))[None])[0, :, 0]
        total = loss = cross_entropy(logits, self.config.label_smoothing)
        if mix:
            penalty = gradient_penalty(self.net, mix[0] * positive + (1 - mix[0]) * negative)
            total = loss + self.config.gradient_penalty * penalty
        self.optimiser.step(torch.autograd.grad(total, self.net.tensors()))
        return loss.detach(), logits.detach()


@dataclass(frozen=True)
class RatioProblem:
    """A policy buffer and a replay buffer, which the discriminator learns to tell apart."""

    policy_buffer: TensorTransitions
    replay: TensorTransitions
    config: TomConfig
    scaling: Scaling  # of (s, a, s' - s)

    @classmethod
    def of(
        cls, policy_buffer: TensorTransitions, replay: TensorTransitions, config: TomConfig
    ) -> "RatioProblem":
        """The problem with inputs z-scored by the replay buffer's moments."""
        return cls(policy_buffer, replay, config, Scaling.of_moves(replay))

    def solve(
        self, discriminator: Discriminator, generator: torch.Generator
    ) -> tuple[StackedMLP, dict[str, float]]:
        """Take the gradient steps on the cross entropy: the (average) network, and metrics.

        The metrics are means over the last tenth of the steps.
        """
        steps = self.config.discriminator_steps
        average = Average(discriminator.net, self.config.parameter_average)
        last = steps - max(steps // 10, 1)
        losses, judged = [], []
        for step, rows in enumerate(self.batches(generator)):
            loss, logits = discriminator.step(*rows)
            average.update()
            if step >= last:
                losses.append(loss)
                judged.append(logits.view(2, -1))
        if not losses:
            return average.net, {}
        logits = torch.cat(judged, dim=1).flatten()
        metrics = {
            "discriminator/loss": float(torch.stack(losses).mean()),
            "discriminator/accuracy": float(accuracy(logits)),
            "discriminator/calibration": float(calibration_error(logits)),
        }
        return average.net, metrics

    @torch.no_grad()
    def log_ratio(self, net: StackedMLP) -> Tensor:
        """r: the logit of every replay row, (N,)."""
        logits = torch.empty_like(self.replay.reward)  # in place: pieces would fragment memory
        size = rows_at_once(logits.device, CHUNK)
        for i in range(0, len(logits), size):
            rows = self.replay[i : i + size]
            logits[i : i + size] = net(self._inputs(rows)[None])[0, :, 0]
        return logits

    def batches(self, generator: torch.Generator) -> Iterator[tuple[Tensor, ...]]:
        """The arguments of `Discriminator.step` for every step.

        (B, D) inputs from the policy buffer and from the replay buffer, and a penalty's `mix`.
        """
        size, steps = self.config.discriminator_batch, self.config.discriminator_steps
        block = block_size(self.replay.obs.device, BLOCK, GPU_BLOCK)
        for first in range(0, steps, block):
            n = min(block, steps - first)
            drawn = []
            for buffer in (self.policy_buffer, self.replay):
                index = uniform_indices(len(buffer), n * size, generator)
                drawn.append(self._inputs(buffer[index]).split(size))
            for rows in zip(*drawn, strict=True):
                if self.config.gradient_penalty > 0:
                    yield *rows, torch.rand(size, 1, generator=generator, device=generator.device)
                else:
                    yield rows

    def _inputs(self, rows: TensorTransitions) -> Tensor:
        """z-scored (s, a, s' - s), (B, 2 O + A), or (s, a), (B, O + A)."""
        if self.config.discriminator_input == "state-actions":
            now = torch.cat((rows.obs, rows.action), dim=1)
            return self.scaling.first(now.shape[1])(now)
        return self.scaling(rows.moves())


def gradient_penalty(net: StackedMLP, x: Tensor) -> Tensor:
    """E[(|d logit / d x| - 1)^2] at x (B, D), ()."""
    x = x.detach().requires_grad_()
    (slope,) = torch.autograd.grad(net(x[None]).sum(), x, create_graph=True)
    return (slope.norm(dim=1) - 1).square().mean()


def cross_entropy(logits: Tensor, smoothing: float) -> Tensor:
    """Mean cross entropy of 2B logits: B policy rows (label 1), then B replay rows (smoothing).

    -(E_p[log c] + E_q[log(1 - c)]) / 2; as printed, eq. 26 has the sign reversed.
    """
    positive, negative = logits.chunk(2)
    if smoothing == 0:
        return (softplus(-positive).mean() + softplus(negative).mean()) / 2
    target = torch.full_like(negative, smoothing)
    return (softplus(-positive).mean() + binary_cross_entropy_with_logits(negative, target)) / 2


def accuracy(logits: Tensor) -> Tensor:
    """Share of rows on the right side: the first half above zero, the second half below."""
    positive, negative = logits.chunk(2)
    return torch.cat((positive > 0, negative < 0)).float().mean()


def calibration_error(logits: Tensor, bins: int = 10) -> Tensor:
    """Expected calibration error of 2B logits: B policy rows, then as many replay rows.

    sum_b n_b / 2B |share of policy rows in bin b - mean c in bin b|, over equal bins of c.
    """
    c = torch.sigmoid(logits)
    label = torch.zeros_like(c)
    label[: len(c) // 2] = 1.0
    which = (c * bins).long().clamp(0, bins - 1)  # NaN, a negative whole number, stays NaN in c
    gap = torch.zeros(bins).to(c).index_add(0, which, label - c)  # n_b (share - mean c)
    return gap.abs().sum() / len(c)


def membership_reward(replay: TensorTransitions, policy_buffer: TensorTransitions) -> Tensor:
    """The ablation without discriminator: 1 on replay rows of the policy buffer, else 0, (N,)."""
    return torch.isin(_row_hash(replay), _row_hash(policy_buffer)).to(replay.obs)


def _row_hash(rows: TensorTransitions) -> Tensor:
    """A 64-bit hash of each row's (s, a, s') bits, independent of the row's position."""
    total = torch.zeros(len(rows), dtype=torch.int64, device=rows.obs.device)
    for part in (rows.obs, rows.action, rows.next_obs):
        for column in part.unbind(1):
            bits = (column + 0.0).view(torch.int32).to(torch.int64)  # + 0.0: -0 equals 0
            total = (total ^ bits) * 0x9E3779B97F4A7C1 + (total >> 29)
    return total
