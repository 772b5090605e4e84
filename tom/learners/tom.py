"""Transition occupancy matching: the replay buffer is weighted towards the policy's occupancy.

Discriminator, dual Q, weights: lines 3-14 of the paper's Algorithm 2.
`occupancy_weights` is the function for other programs; `TomLearner` is used by trainings.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from tom.config import TomConfig
from tom.data.sampling import normalise
from tom.data.scaling import Scaling
from tom.data.transitions import TensorTransitions, Transitions
from tom.learners.base import DEGENERATE, FitContext, Policy, Weighting, uniform
from tom.learners.discriminator import (
    Discriminator,
    RatioProblem,
    discriminator_net,
    membership_reward,
)
from tom.learners.dual import DualProblem, QFunction, q_net
from tom.learners.terms import Terms, divergence

__all__ = ["Occupancy", "TomConfig", "TomLearner", "occupancy_weights"]

MAX_START_GAP = 1.0  # covered starts lie within Q's range, uncovered ones soon far below it
RUNAWAY = (
    "runaway-dual",
    "TOM's dual Q falls without bound at the start states: the replay buffer does not hold what "
    "the policy does there, and the weights cannot be trusted",
)
"""kind of the notice about a dual problem without solution"""

ENDS_UNDER_KL = (
    "kl-drops-terminations",
    "KL with normalised weights drives the weight of terminated transitions to zero: use chi2 "
    "or the stationary flow where episodes terminate",
)
"""kind of the notice about KL on a buffer with terminated transitions"""


@dataclass(frozen=True)
class Occupancy:
    """The weights (N,) of a replay buffer, mean 1, and the terms of each weight."""

    weights: Tensor
    terms: Terms
    metrics: dict[str, float]
    notices: tuple[tuple[str, str], ...]

    @property
    def log_ratio(self) -> Tensor:
        """The r (N,) that was fed to Q."""
        return self.terms.log_ratio


class Networks:
    """TOM's two networks for given dimensions; each can be restarted."""

    def __init__(
        self,
        obs_dim: int,
        action_dim: int,
        config: TomConfig,
        generator: torch.Generator,
        device: torch.device | None = None,
    ) -> None:
        self.dims = obs_dim, action_dim
        self.config = config
        device = device or generator.device
        net = discriminator_net(*self.dims, config, generator).to(device)
        self.discriminator = Discriminator(net, config)
        self.q = QFunction(q_net(*self.dims, config, generator).to(device), config)

    def restart_discriminator(self, generator: torch.Generator) -> None:
        self.discriminator.restart(discriminator_net(*self.dims, self.config, generator))

    def restart_q(self, generator: torch.Generator) -> None:
        self.q.restart(q_net(*self.dims, self.config, generator))


def estimate(
    networks: Networks,
    replay: TensorTransitions,
    policy_buffer: TensorTransitions,
    policy: Policy,
    initial_obs: Tensor,
    generator: torch.Generator,
) -> Occupancy:
    """Train the networks further and compute the weights of `replay` from them."""
    config = networks.config
    metrics: dict[str, float] = {}
    if config.discriminator:
        ratio = RatioProblem.of(policy_buffer, replay, config.discriminator_input)
        net, metrics = ratio.solve(networks.discriminator, generator)
        log_ratio = ratio.log_ratio(net)
        scaling = ratio.scaling.first(sum(networks.dims))  # of (s, a); (s' - s) comes after
    else:
        log_ratio = membership_reward(replay, policy_buffer)
        scaling = Scaling.of((replay.obs, replay.action))
    problem = DualProblem(replay, log_ratio, initial_obs, policy, config, scaling)
    dual = problem.minimise(networks.q, generator)
    terms = problem.terms(dual.net, generator)
    raw, q = terms.raw(config), terms.now
    weights, degenerate = normalise(raw)
    start_gap = problem.start_gap(dual.net, q, generator)
    metrics |= dual.metrics | {
        "dual/loss": dual.loss,
        "dual/q_mean": float(q.mean()),
        "dual/start_gap": start_gap,
        "weights/raw_mean": float(raw.mean()),
    }
    conditions = (
        (DEGENERATE, degenerate),
        (RUNAWAY, start_gap > MAX_START_GAP),
        (ENDS_UNDER_KL, _kl_drops_ends(config) and bool(replay.terminated.any())),
    )
    notices = tuple(notice for notice, holds in conditions if holds)
    return Occupancy(weights, terms, metrics, notices)


def _kl_drops_ends(config: TomConfig) -> bool:
    """Whether the flow loses mass at ends although KL's weights keep their sum."""
    return divergence(config).normalised and config.flow == "discounted"


def occupancy_weights(
    buffer: Transitions,
    policy_buffer: Transitions,
    policy: Policy,
    initial_obs: Tensor | np.ndarray,
    config: TomConfig,
    generator: torch.Generator,
) -> Occupancy:
    """Weights for `buffer` under which its rows look like the policy's own transitions.

    w = f*'(r + g E_{a'~pi}[Q(s', a')] - Q(s, a)) at the Q that minimises the dual (paper, eqs. 16
    and 17), scaled to mean 1. `buffer` holds N transitions, `policy_buffer` recent ones of the
    policy; both may be numpy arrays or tensors. `policy(obs, n, generator)` returns (n, B, A)
    actions for obs (B, O); with a method `support(obs) -> (actions (K, B, A), probs (K, B))` the
    expectation over a' is exact. `initial_obs` (M0, O) are draws of the start distribution. Both
    networks start anew; all randomness comes from `generator`.
    """
    replay, policy_rows = buffer.torch(), policy_buffer.torch()
    starts = torch.as_tensor(initial_obs).to(replay.obs)
    dims = replay.obs.shape[1], replay.action.shape[1]
    networks = Networks(*dims, config, generator, replay.obs.device)
    return estimate(networks, replay, policy_rows, policy, starts, generator)


class TomLearner:
    """Occupancy weights, with a Q that is trained further at every fit.

    Uniform, and not ready, until the policy has taken `config.warmup` steps in the environment.
    """

    def __init__(
        self,
        config: TomConfig,
        obs_dim: int,
        action_dim: int,
        generator: torch.Generator,
    ) -> None:
        self.config = config
        self.networks = Networks(obs_dim, action_dim, config, generator)
        self.degenerate = 0

    def weigh(self, context: FitContext) -> Weighting:
        config, networks = self.config, self.networks
        if context.on_policy_steps < config.warmup:
            return uniform(context.replay, ready=False)
        if config.discriminator_reset:
            networks.restart_discriminator(context.generator)
        if config.starts_afresh:
            networks.restart_q(context.generator)
        occupancy = estimate(
            networks,
            context.replay,
            context.policy_buffer,
            context.policy,
            context.initial_obs,
            context.generator,
        )
        degenerate = DEGENERATE in occupancy.notices
        self.degenerate += degenerate
        return Weighting(
            weights=occupancy.weights,
            log_ratio=occupancy.log_ratio,
            terms=None if degenerate else occupancy.terms,
            ready=not degenerate,
            clipped=True,
            metrics={**occupancy.metrics, "weights/degenerate": float(self.degenerate)},
            notices=occupancy.notices,
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
