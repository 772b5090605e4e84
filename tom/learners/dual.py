"""The dual problem of TOM (paper, eq. 16) over a network Q, and the weights at its Q (eq. 17)."""

from collections.abc import Hashable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import torch
from torch import Tensor
from torch.nn.functional import relu, softplus

from tom.backprop import forward_trace, gradients
from tom.config import TomConfig
from tom.data.sampling import block_size, uniform_indices
from tom.data.scaling import Scaling
from tom.data.transitions import TensorTransitions
from tom.divergences import divergence
from tom.learners.averaging import Average
from tom.learners.base import Policy, policy_actions
from tom.learners.training import Trained
from tom.lockstep import Work
from tom.nn import StackedMLP, rows_at_once

CHUNK = 2048  # rows weighed at once; they stay in the processor's cache
BLOCK, GPU_BLOCK = 8, 100  # minibatches gathered, and their actions drawn, at once


@dataclass(frozen=True)
class Batch:
    """B transitions and B start states as Q reads them; many members' have an M in front."""

    inputs: Tensor  # (B + K B + L B, O + A): (s, a), every (s', a'), every (s0, a0)
    next_probs: Tensor  # (K, B) of the a'
    start_probs: Tensor  # (L, B) of the a0
    log_ratio: Tensor  # (B,)
    terminated: Tensor  # (B,)

    def fields(self) -> tuple[Tensor, ...]:
        return self.inputs, self.next_probs, self.start_probs, self.log_ratio, self.terminated


@dataclass(frozen=True)
class Values:
    """What the dual needs of Q on a batch."""

    now: Tensor  # Q(s, a), (B,)
    following: Tensor  # E_{a'~pi}[Q(s', a')], (B,), before any mask
    start: Tensor  # E_{a~pi}[Q(s0, a)], (B,)


def q_net(
    obs_dim: int, action_dim: int, config: TomConfig, generator: torch.Generator
) -> StackedMLP:
    """A fresh Q with two ReLU layers: (1, B, O + A) -> (1, B, 1)."""
    sizes = [obs_dim + action_dim, config.q_hidden, config.q_hidden, 1]
    return StackedMLP(1, sizes, relu, [generator])


def dual_argument(values: Values, log_ratio: Tensor, terminated: Tensor, discount: float) -> Tensor:
    """y = r + g (1 - terminated) E_{a'}[Q(s', a')] - Q(s, a), (..., B).

    Truncation masks nothing.
    """
    return log_ratio + discount * (1 - terminated) * values.following - values.now


def dual_loss(values: Values, batch: Batch, config: TomConfig) -> Tensor:
    """(1-g) E_{mu0,pi}[Q(s0, a0)] + E_q[f*(y)] (paper, eq. 16), (...,) of a batch (..., B)."""
    f = divergence(config.divergence, config.conjugate)
    y = dual_argument(values, batch.log_ratio, batch.terminated, config.discount)
    return (1 - config.discount) * values.start.mean(-1) + f.dual_term(y)


def as_value(output: Tensor, config: TomConfig) -> Tensor:
    """Q from the network's output."""
    return softplus(output) if config.q_non_negative else output


def values_of(q: Tensor, batch: Batch, config: TomConfig) -> Values:
    """What the dual needs of Q at `batch.inputs`, (..., B + K B + L B)."""
    probs = batch.next_probs, batch.start_probs
    b = batch.log_ratio.shape[-1]
    now, *others = q.split([b, *(p.shape[-2] * b for p in probs)], -1)
    following, start = (
        (p * of.unflatten(-1, p.shape[-2:])).sum(-2) for p, of in zip(probs, others, strict=True)
    )
    return Values(now, following.detach() if config.semi_gradient else following, start)


class QFunction(Trained):
    """TOM's dual variable, of one member or of many in lock-step."""

    def __init__(self, net: StackedMLP, config: TomConfig) -> None:
        super().__init__(net, config.q_lr, config.q_weight_decay)
        self.config = config

    @torch.no_grad()
    def step(self, bias_step: Tensor, *batches: Tensor) -> Tensor:
        """A gradient step on the fields of `Batch`, members stacked in front; the losses (M,).

        `bias_step` (M,) is that of `DualProblem.bias_step`.
        """
        trace = forward_trace(self.net, batches[0])
        output = trace.output[..., 0].requires_grad_()
        with torch.enable_grad():
            batch, q = Batch(*batches), as_value(output, self.config)
            losses = dual_loss(values_of(q, batch, self.config), batch, self.config)
            (slope,) = torch.autograd.grad(losses.sum(), output)
        found = gradients(self.net, trace, slope.unsqueeze(-1))
        self.optimiser.step(found)
        if self.config.q_bias_step:
            self.net.layers[-1][1].sub_(bias_step[:, None, None] * found[-1])
        return losses.detach()


@dataclass
class Minimise(Work):
    """Work: gradient steps on the dual; then `net` is Q's (average) network."""

    rank: ClassVar[int] = 3
    problem: "DualProblem"
    subject: QFunction
    generator: torch.Generator
    net: StackedMLP = field(init=False)
    loss: float = field(init=False)  # mean of the last tenth

    @property
    def kind(self) -> Hashable:
        return repr(self.problem.config)

    @classmethod
    def do(cls, works: "Sequence[Minimise]", subject: QFunction) -> None:
        config = subject.config
        averages = [Average(w.subject.net, config.parameter_average) for w in works]
        bias_step = works[0].problem.log_ratio.new_tensor([w.problem.bias_step() for w in works])
        losses = []
        for batches in zip(*(w.problem.batches(w.generator) for w in works), strict=True):
            stacked = [
                torch.stack(parts) for parts in zip(*(one.fields() for one in batches), strict=True)
            ]
            losses.append(subject.step(bias_step, *stacked).clone())
            for average in averages:
                average.update()
        tail = torch.stack(losses[-max(len(losses) // 10, 1) :])
        for work, average, loss in zip(works, averages, tail.unbind(1), strict=True):
            work.net, work.loss = average.net, float(loss.mean())


@dataclass(frozen=True)
class DualProblem:
    """A replay buffer with its r, a policy and a start distribution: what Q is fitted to."""

    replay: TensorTransitions
    log_ratio: Tensor  # (N,)
    initial_obs: Tensor  # (M0, O)
    policy: Policy
    config: TomConfig
    scaling: Scaling  # of (s, a)

    def minimise(self, q: QFunction, generator: torch.Generator) -> tuple[StackedMLP, float]:
        """Gradient steps on the dual: Q's (average) network, and the last tenth's mean loss."""
        work = Minimise(self, q, generator)
        Minimise.do([work], q)
        return work.net, work.loss

    @torch.no_grad()
    def solution(self, net: StackedMLP, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Weights f*'(y), not normalised, and Q(s, a) of every replay row, (N,) each."""
        samples, size = self.config.action_samples, rows_at_once(self.log_ratio.device, CHUNK)
        y, now = torch.empty_like(self.log_ratio), torch.empty_like(self.log_ratio)
        for i in range(0, len(y), size):
            part = slice(i, i + size)
            rows = self.replay[part]
            inputs, probs = self._policy_inputs(rows.next_obs, samples, generator)
            every = torch.cat((self._inputs(rows.obs, rows.action), inputs.flatten(0, 1)))
            q = torch.cat([self._q(net, block) for block in every.split(size)])
            following = (probs * q[len(rows) :].view_as(probs)).sum(0)
            values = Values(q[: len(rows)], following, following)
            y[part] = dual_argument(
                values, self.log_ratio[part], rows.terminated, self.config.discount
            )
            now[part] = values.now
        f = divergence(self.config.divergence, self.config.conjugate)
        return f.weights(y), now

    @torch.no_grad()
    def start_gap(self, net: StackedMLP, q: Tensor, generator: torch.Generator) -> float:
        """How far Q(s0, a ~ pi) lies below Q on the replay, `q` (N,), in 1 + its range.

        Near zero where the replay covers the policy's starts. Where it does not, nothing holds Q
        there, the dual is unbounded below and this grows from fit to fit.
        """
        starts = self.initial_obs[:CHUNK]
        inputs, probs = self._policy_inputs(starts, 1, generator)
        q_start = (probs * self._q(net, inputs.flatten(0, 1)).view_as(probs)).sum(0)
        low, high = torch.quantile(q, q.new_tensor([0.001, 0.999]))
        return float((low - q_start).clamp(min=0).mean() / (1 + high - low))

    def bias_step(self) -> float:
        """The step of plain gradient descent on Q's output bias, in units of Q.

        A shift of Q by c moves y by (g (1 - terminated) - 1) c, the next to nothing that makes
        gradient descent slow and the curvature E[(1 - g (1 - terminated))^2] known. Under KL the
        weights do not depend on it.
        """
        if self.config.divergence == "kl" or self.config.q_bias_step == 0:
            return 0.0
        shift = 1 - self.config.discount * (1 - self.replay.terminated)
        return self.config.q_bias_step / float(shift.square().mean())

    def batches(self, generator: torch.Generator) -> Iterator[Batch]:
        """`q_steps` batches, drawn uniformly with replacement, gathered a block at a time."""
        size, samples = self.config.q_batch, self.config.action_samples
        block = block_size(self.replay.obs.device, BLOCK, GPU_BLOCK)
        for first in range(0, self.config.q_steps, block):
            n = min(block, self.config.q_steps - first)
            index = self._draw(len(self.replay), n * size, generator)
            start = self._draw(len(self.initial_obs), n * size, generator)
            rows = self.replay[index]
            following, next_probs = self._policy_inputs(rows.next_obs, samples, generator)
            # One a0 will do: its expectation enters linearly, that over a' sits inside f*.
            starts, start_probs = self._policy_inputs(self.initial_obs[start], 1, generator)
            now = self._inputs(rows.obs, rows.action)[None]
            inputs = torch.cat([_steps(x, n) for x in (now, following, starts)], dim=1)
            yield from map(
                Batch,
                inputs,
                next_probs.split(size, dim=1),
                start_probs.split(size, dim=1),
                self.log_ratio[index].split(size),
                rows.terminated.split(size),
            )

    def _q(self, net: StackedMLP, inputs: Tensor) -> Tensor:
        return as_value(net(inputs[None])[0, :, 0], self.config)

    def _inputs(self, obs: Tensor, action: Tensor) -> Tensor:
        return self.scaling(torch.cat((obs, action), dim=-1))

    def _policy_inputs(
        self, obs: Tensor, n: int, generator: torch.Generator
    ) -> tuple[Tensor, Tensor]:
        """(s, a ~ pi) as Q reads them, (K, B, O + A), and the probability of each a, (K, B)."""
        actions, probs = policy_actions(self.policy, obs, n, generator)
        return self._inputs(obs.expand(len(actions), *obs.shape), actions), probs

    def _draw(self, high: int, n: int, generator: torch.Generator) -> Tensor:
        return uniform_indices(high, n, generator).to(self.replay.obs.device)


def _steps(inputs: Tensor, n: int) -> Tensor:
    """(K, n B, D), B rows for each of n steps -> (n, K B, D)."""
    return inputs.unflatten(1, (n, -1)).transpose(0, 1).flatten(1, 2)
