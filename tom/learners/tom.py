"""Transition occupancy matching: the replay buffer weighed by the current policy's footprint.

Discriminator, dual Q, weights: lines 3-11 of the paper's Algorithm 2.
`occupancy_weights` is the way in for other programs; `TomLearner` is what a training keeps.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from tom.config import TomConfig
from tom.data.sampling import normalise
from tom.data.transitions import TensorTransitions, Transitions
from tom.learners.base import DEGENERATE, FitContext, Policy, Weighting, uniform
from tom.learners.discriminator import Discriminator, discriminator_net, membership_reward
from tom.learners.dual import DualProblem, q_net
from tom.learners.scaling import Scaling
from tom.nn import StackedMLP

__all__ = ["Occupancy", "TomConfig", "TomLearner", "occupancy_weights"]

MAX_START_GAP = 1.0  # a covered start lies within Q's range; an uncovered one soon far below it
RUNAWAY = (
    "runaway-dual",
    "TOM's dual Q falls without bound at the start states: the replay buffer does not hold what "
    "the policy does there, and the weights cannot be trusted",
)
"""The notice of a fit whose dual problem has no solution."""

ENDS_UNDER_KL = (
    "kl-drops-terminations",
    "KL with normalised weights drives the weight of terminated transitions to zero: use chi2 "
    "where episodes terminate",
)
"""The notice of a fit under KL on a buffer with terminated transitions."""


@dataclass(frozen=True)
class Occupancy:
    """The weights (N,) of a replay buffer, mean 1, and the r (N,) that was fed to Q."""

    weights: Tensor
    log_ratio: Tensor
    metrics: dict[str, float]
    notices: tuple[tuple[str, str], ...]


class Trained:
    """A network and the optimiser that goes on with it from fit to fit."""

    def __init__(self, net: StackedMLP, lr: float, weight_decay: float = 0.0) -> None:
        self.net = net
        self.optimiser = torch.optim.Adam(
            net.parameters(), lr=lr, weight_decay=weight_decay, fused=True
        )

    def state_dict(self) -> dict[str, Any]:
        return {"net": self.net.state_dict(), "optimiser": self.optimiser.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.net.load_state_dict(state["net"])
        self.optimiser.load_state_dict(state["optimiser"])


class Networks:
    """TOM's two networks for given dimensions; either may be started afresh."""

    def __init__(
        self,
        obs_dim: int,
        action_dim: int,
        config: TomConfig,
        device: torch.device | str,
        generator: torch.Generator,
    ) -> None:
        self.dims = obs_dim, action_dim
        self.config = config
        self.device = device
        self.restart_discriminator(generator)
        self.restart_q(generator)

    def restart_discriminator(self, generator: torch.Generator) -> None:
        net = discriminator_net(*self.dims, self.config, generator).to(self.device)
        self.discriminator = Trained(net, self.config.discriminator_lr)

    def restart_q(self, generator: torch.Generator) -> None:
        net = q_net(*self.dims, self.config, generator).to(self.device)
        self.q = Trained(net, self.config.q_lr, self.config.q_weight_decay)


def estimate(
    networks: Networks,
    replay: TensorTransitions,
    policy_buffer: TensorTransitions,
    policy: Policy,
    initial_obs: Tensor,
    generator: torch.Generator,
) -> Occupancy:
    """Train the networks further and weigh `replay` by them."""
    config = networks.config
    metrics: dict[str, float] = {}
    if config.discriminator:
        judge = Discriminator(networks.discriminator.net, replay, policy_buffer)
        metrics |= judge.train(networks.discriminator.optimiser, config, generator)
        log_ratio = judge.log_ratio()
    else:
        log_ratio = membership_reward(replay, policy_buffer)
    scaling = Scaling.of((replay.obs, replay.action))
    problem = DualProblem(replay, log_ratio, initial_obs, policy, config, scaling)
    net, loss = problem.minimise(networks.q.net, networks.q.optimiser, generator)
    raw, q = problem.solution(net, generator)
    weights, degenerate = normalise(raw)
    start_gap = problem.start_gap(net, q, generator)
    metrics |= {
        "dual/loss": loss,
        "dual/q_mean": float(q.mean()),
        "dual/start_gap": start_gap,
        "weights/raw_mean": float(raw.mean()),
    }
    found = (
        (DEGENERATE, degenerate),
        (RUNAWAY, start_gap > MAX_START_GAP),
        (ENDS_UNDER_KL, config.divergence == "kl" and bool(replay.terminated.any())),
    )
    notices = tuple(notice for notice, holds in found if holds)
    return Occupancy(weights, log_ratio, metrics, notices)


def occupancy_weights(
    buffer: Transitions,
    policy_buffer: Transitions,
    policy: Policy,
    initial_obs: Tensor | np.ndarray,
    config: TomConfig,
    generator: torch.Generator,
) -> Occupancy:
    """Weigh `buffer` by how much the policy's own transitions look like each of its rows.

    w = f*'(r + g E_{a'~pi}[Q(s', a')] - Q(s, a)) at the Q that minimises the dual (paper, eqs. 16
    and 17), scaled to mean 1. `buffer` holds N transitions, `policy_buffer` those the policy made
    lately; both may be numpy arrays or tensors. `policy(obs, n, generator)` returns (n, B, A)
    actions for obs (B, O); with a method `support(obs) -> (actions (K, B, A), probs (K, B))` the
    expectation over a' is exact. `initial_obs` (M0, O) are draws of the start distribution. Both
    networks start afresh; all randomness comes from `generator`.
    """
    replay, lately = buffer.torch(), policy_buffer.torch()
    starts = torch.as_tensor(initial_obs).to(replay.obs)
    dims = replay.obs.shape[1], replay.action.shape[1]
    networks = Networks(*dims, config, replay.obs.device, generator)
    return estimate(networks, replay, lately, policy, starts, generator)


class TomLearner:
    """Occupancy weights, with a Q that goes on from fit to fit.

    Uniform, and not ready, until the policy has taken `config.warmup` steps in the environment.
    """

    name = "tom"

    def __init__(
        self,
        config: TomConfig,
        obs_dim: int,
        action_dim: int,
        generator: torch.Generator,
        device: torch.device | str = "cpu",
    ) -> None:
        self.config = config
        self.networks = Networks(obs_dim, action_dim, config, device, generator)
        self.degenerate = 0

    def weigh(self, context: FitContext) -> Weighting:
        config, networks = self.config, self.networks
        if context.on_policy_steps < config.warmup:
            return uniform(context.replay, ready=False)
        if config.discriminator_reset:
            networks.restart_discriminator(context.generator)
        if config.q_reset:
            networks.restart_q(context.generator)
        found = estimate(
            networks,
            context.replay,
            context.policy_buffer,
            context.policy,
            context.initial_obs,
            context.generator,
        )
        degenerate = DEGENERATE in found.notices
        self.degenerate += degenerate
        return Weighting(
            weights=found.weights,
            log_ratio=found.log_ratio,
            ready=not degenerate,
            metrics={**found.metrics, "weights/degenerate": float(self.degenerate)},
            notices=found.notices,
        )

    def state_dict(self) -> dict[str, Any]:
        return {
            "discriminator": self.networks.discriminator.state_dict(),
            "q": self.networks.q.state_dict(),
            "degenerate": self.degenerate,
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.networks.discriminator.load_state_dict(state["discriminator"])
        self.networks.q.load_state_dict(state["q"])
        self.degenerate = state["degenerate"]
