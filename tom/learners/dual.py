"""The dual problem of TOM (paper, eq. 16) for a network Q, and the weights at that Q (eq. 17)."""

from collections.abc import Callable, Iterator
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor
from torch.nn.functional import relu, softplus

from tom.config import TomConfig
from tom.data.sampling import block_size, held_out_rows, uniform_indices
from tom.data.scaling import Scaling
from tom.data.transitions import TensorTransitions
from tom.learners.base import Policy, policy_actions
from tom.learners.terms import Flow, Terms, divergence
from tom.nn.mlp import StackedMLP, rows_at_once
from tom.nn.trained import Average, Trained
from tom.rng import fork

CHUNK = 2048  # rows weighed at once; they stay in the processor's cache
HELD_OUT = 4096  # draws of held-out rows that validate Q
BLOCK, GPU_BLOCK = 8, 100  # minibatches gathered, and their actions drawn, at once


@dataclass(frozen=True)
class Batch:
    """B transitions and B start states as inputs of Q."""

    inputs: Tensor  # (B + K B + L B, O + A): (s, a), every (s', a'), every (s0, a0)
    next_probs: Tensor  # (K, B) of the a'
    start_probs: Tensor  # (L, B) of the a0
    log_ratio: Tensor  # (B,)
    ends: Tensor  # (B,), as the flow counts them


@dataclass(frozen=True)
class Values:
    """The values of Q on a batch that the dual needs."""

    now: Tensor  # Q(s, a), (B,)
    following: Tensor  # E_{a'~pi}[Q(s', a')], (B,), before any mask
    start: Tensor  # E_{a~pi}[Q(s0, a)], (B,)


def dual_argument(values: Values, log_ratio: Tensor, ends: Tensor, flow: Flow) -> Tensor:
    """y = r + F Q, (..., B): r + g E_{a'~pi}[Q(s', a')] - Q(s, a) away from ends."""
    start = values.start.mean(-1, keepdim=True)
    return log_ratio + flow.after(values.following, start, ends) - values.now


def dual_loss(values: Values, batch: Batch, config: TomConfig) -> Tensor:
    """The dual's value on a batch (..., B), (...,).

    (1-g) E_{mu0,pi}[Q(s0, a0)] + E_q[f*(y)] (paper, eq. 16); under a stationary flow
    lambda + E_q[f*(y - lambda)] at the minimising lambda, which is a constant for Q's gradient (by
    the envelope theorem).
    """
    f, flow = divergence(config), Flow.of(config)
    y = dual_argument(values, batch.log_ratio, batch.ends, flow)
    if flow.normalised:
        multiplier = f.multiplier(y.detach())
        return multiplier + f.dual_term(y - multiplier[..., None])
    return (1 - flow.discount) * values.start.mean(-1) + f.dual_term(y)


def as_value(output: Tensor, config: TomConfig) -> Tensor:
    """Q from the network's output."""
    return softplus(output) if config.q_non_negative else output


def values_of(q: Tensor, batch: Batch, config: TomConfig) -> Values:
    """The values that the dual needs, from Q at `batch.inputs`, (..., B + K B + L B)."""
    probs = batch.next_probs, batch.start_probs
    b = batch.log_ratio.shape[-1]
    now, *others = q.split([b, *(p.shape[-2] * b for p in probs)], -1)
    following, start = (
        (p * of.unflatten(-1, p.shape[-2:])).sum(-2) for p, of in zip(probs, others, strict=True)
    )
    return Values(now, following.detach() if config.semi_gradient else following, start)


class QFunction(Trained):
    """TOM's dual variable, two ReLU layers: (1, B, O + A) -> (1, B, 1); `fresh` draws a new one."""

    def __init__(
        self, obs_dim: int, action_dim: int, config: TomConfig, generator: torch.Generator
    ) -> None:
        sizes = [obs_dim + action_dim, config.q_hidden, config.q_hidden, 1]
        self.fresh = partial(StackedMLP, 1, sizes, relu)
        super().__init__(self.fresh(generator), config.q_lr, config.q_weight_decay)
        self.config = config

    def step(self, bias_step: float, batch: Batch) -> Tensor:
        """A gradient step; the loss before it. `bias_step` is that of `DualProblem.bias_step`."""
        q = as_value(self.net(batch.inputs[None])[0, :, 0], self.config)
        loss = dual_loss(values_of(q, batch, self.config), batch, self.config)
        grads = torch.autograd.grad(loss, self.net.tensors())
        self.optimiser.step(grads)
        if self.config.q_bias_step:
            with torch.no_grad():
                self.net.layers[-1][1].sub_(bias_step * grads[-1])
        return loss.detach()


class Validation:
    """Evaluates a network's held-out loss from time to time; keeps the network with the lowest.

    A training is over after `q_patience` evaluations without a new minimum.
    """

    def __init__(
        self, net: StackedMLP, loss: Callable[[StackedMLP], float], config: TomConfig
    ) -> None:
        self._net, self._loss, self._config = net, loss, config
        self.best = net  # the last one if every loss was NaN
        self._least, self._kept_at, self._idle = float("inf"), 0, 0

    def is_over(self, step: int) -> bool:
        """Evaluate the network if it is due after this step; whether its training is over."""
        config = self._config
        if step % config.q_check_every == 0 or step == config.q_steps:
            loss = self._loss(self._net)
            self._idle += 1
            if loss < self._least:
                self.best = deepcopy(self._net).requires_grad_(False)
                self._least, self._kept_at, self._idle = loss, step, 0
        return self._idle >= config.q_patience

    @property
    def metrics(self) -> dict[str, float]:
        return {"dual/holdout_loss": self._least, "dual/steps": float(self._kept_at)}


@dataclass(frozen=True)
class DualProblem:
    """The data for Q: a replay buffer with its r, a policy and a start distribution.

    Batches are drawn from the rows numbered in `drawn_from`, or from all.
    """

    replay: TensorTransitions
    log_ratio: Tensor  # (N,)
    initial_obs: Tensor  # (M0, O)
    policy: Policy
    config: TomConfig
    scaling: Scaling  # of (s, a)
    drawn_from: Tensor | None = None  # (n,) int64

    @property
    def flow(self) -> Flow:
        return Flow.of(self.config)

    def minimise(
        self, q: QFunction, generator: torch.Generator
    ) -> tuple[StackedMLP, dict[str, float]]:
        """Take the gradient steps on the dual: the last (or average) network, and metrics.

        If episodes are held out, only the others are trained on, and the network is that of the
        lowest held-out loss. `dual/loss` is the mean over the last tenth of the steps.
        """
        average = Average(q.net, self.config.parameter_average)
        problem, judge, source = self, None, generator
        if self.config.q_holdout:
            problem, held_out = self.split(generator)
            loss = held_out.loss_of(HELD_OUT, generator)
            judge = Validation(average.net, loss, self.config)
            source = fork(generator)  # later draws do not depend on when this stops
        bias_step, losses = problem.bias_step(), []
        for step, batch in enumerate(problem.batches(source), 1):
            losses.append(q.step(bias_step, batch))
            average.update()
            if judge and judge.is_over(step):
                break
        loss = {"dual/loss": float(torch.stack(losses[-max(len(losses) // 10, 1) :]).mean())}
        return (judge.best, judge.metrics | loss) if judge else (average.net, loss)

    def split(self, generator: torch.Generator) -> "tuple[DualProblem, DualProblem]":
        """The same problem on the training episodes, and on the held-out ones."""
        held_out = held_out_rows(self.replay, self.config.q_holdout, generator)
        parts = (~held_out).nonzero().squeeze(1), held_out.nonzero().squeeze(1)
        return replace(self, drawn_from=parts[0]), replace(self, drawn_from=parts[1])

    def loss_of(self, rows: int, generator: torch.Generator) -> Callable[[StackedMLP], float]:
        """The dual's value as a function of the network, on `rows` fixed draws."""
        config = self.config.but(q_batch=rows, q_steps=1)
        (batch,) = replace(self, config=config).batches(generator)

        @torch.no_grad()
        def loss(net: StackedMLP) -> float:
            q = self._q(net, batch.inputs)
            return float(dual_loss(values_of(q, batch, self.config), batch, self.config))

        return loss

    @torch.no_grad()
    def terms(self, net: StackedMLP, generator: torch.Generator) -> Terms:
        """The terms of y, for every replay row."""
        samples, size = self.config.action_samples, rows_at_once(self.log_ratio.device, CHUNK)
        now, following = torch.empty_like(self.log_ratio), torch.empty_like(self.log_ratio)
        restart, flow = torch.zeros_like(self.log_ratio), self.flow
        ends = flow.ends(self.replay)
        if flow.restarts:
            start = self.start_values(net, samples, generator).mean(-1, keepdim=True)
            restart = flow.restarting(start, ends)
        for i in range(0, len(now), size):
            part = slice(i, i + size)
            rows = self.replay[part]
            inputs, probs = self._policy_inputs(rows.next_obs, samples, generator)
            every = torch.cat((self._inputs(rows.obs, rows.action), inputs.flatten(0, 1)))
            q = torch.cat([self._q(net, block) for block in every.split(size)])
            now[part] = q[: len(rows)]
            value = (probs * q[len(rows) :].view_as(probs)).sum(0)
            following[part] = flow.going_on(value, ends[part])
        return Terms(self.log_ratio, now, following, restart)

    @torch.no_grad()
    def start_values(self, net: StackedMLP, n: int, generator: torch.Generator) -> Tensor:
        """E_{a~pi}[Q(s0, a)] from n actions, at the first start states, (B,)."""
        inputs, probs = self._policy_inputs(self.initial_obs[:CHUNK], n, generator)
        return (probs * self._q(net, inputs.flatten(0, 1)).view_as(probs)).sum(0)

    @torch.no_grad()
    def start_gap(self, net: StackedMLP, q: Tensor, generator: torch.Generator) -> float:
        """How far Q(s0, a ~ pi) lies below Q on the replay, `q` (N,), relative to 1 + its range.

        Near zero if the replay covers the policy's starts. If it does not, Q is unconstrained
        there, the dual is unbounded below, and the gap grows from fit to fit.
        """
        q_start = self.start_values(net, 1, generator)
        low, high = torch.quantile(q, q.new_tensor([0.001, 0.999]))
        return float((low - q_start).clamp(min=0).mean() / (1 + high - low))

    def bias_step(self) -> float:
        """The step of plain gradient descent on Q's output bias, in units of Q.

        A shift of Q by c changes y by only -c times the flow's `shift`, so that gradient descent is
        slow; but its curvature is known: E[shift^2] under `chi2` where every weight is positive,
        else less. Under a stationary flow, and but for ends under KL, weights do not depend on it.
        """
        free = divergence(self.config).normalised or self.flow.normalised
        if free or self.config.q_bias_step == 0:
            return 0.0
        shift = self.flow.shift(self.flow.ends(self.replay))
        return self.config.q_bias_step / float(shift.square().mean())

    def batches(self, generator: torch.Generator) -> Iterator[Batch]:
        """`q_steps` batches, drawn uniformly with replacement, gathered a block at a time."""
        size, samples = self.config.q_batch, self.config.action_samples
        block = block_size(self.replay.obs.device, BLOCK, GPU_BLOCK)
        for first in range(0, self.config.q_steps, block):
            n = min(block, self.config.q_steps - first)
            chosen = self.drawn_from
            count = len(self.replay if chosen is None else chosen)
            index = uniform_indices(count, n * size, generator)
            index = index if chosen is None else chosen[index]
            start = uniform_indices(len(self.initial_obs), n * size, generator)
            rows = self.replay[index]
            following, next_probs = self._policy_inputs(rows.next_obs, samples, generator)
            # One a0 for each s0 is enough: it enters as a mean over the batch, inside f* after ends
            # that restart, but a' alone for its row.
            starts, start_probs = self._policy_inputs(self.initial_obs[start], 1, generator)
            now = self._inputs(rows.obs, rows.action)[None]
            # (K, n B, D), B rows for each of n steps -> (n, K B, D)
            parts = [x.unflatten(1, (n, -1)).transpose(0, 1) for x in (now, following, starts)]
            inputs = torch.cat([x.flatten(1, 2) for x in parts], dim=1)
            yield from map(
                Batch,
                inputs,
                next_probs.split(size, dim=1),
                start_probs.split(size, dim=1),
                self.log_ratio[index].split(size),
                self.flow.ends(rows).split(size),
            )

    def _q(self, net: StackedMLP, inputs: Tensor) -> Tensor:
        return as_value(net(inputs[None])[0, :, 0], self.config)

    def _inputs(self, obs: Tensor, action: Tensor) -> Tensor:
        return self.scaling(torch.cat((obs, action), dim=-1))

    def _policy_inputs(
        self, obs: Tensor, n: int, generator: torch.Generator
    ) -> tuple[Tensor, Tensor]:
        """Inputs (s, a ~ pi) of Q, (K, B, O + A), and the probability of each a, (K, B)."""
        actions, probs = policy_actions(self.policy, obs, n, generator)
        return self._inputs(obs.expand(len(actions), *obs.shape), actions), probs
