"""Transition occupancy matching: the replay buffer is weighted towards the policy's occupancy.

Discriminator, dual Q, weights: lines 3-14 of the paper's Algorithm 2.
`occupancy_weights` is the function for other programs; `TomLearner` is used by trainings.
"""

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from tom.config import TomConfig
from tom.data.scaling import Scaling
from tom.data.transitions import TensorTransitions, Transitions
from tom.learners.base import FitContext, Policy, Weighting, uniform, weighted
from tom.learners.discriminator import Discriminator, RatioProblem, membership_reward
from tom.learners.dual import DualProblem, QFunction
from tom.learners.terms import divergence

__all__ = ["TomConfig", "TomLearner", "occupancy_weights"]

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


def estimate(
    discriminator: Discriminator,
    q: QFunction,
    replay: TensorTransitions,
    policy_buffer: TensorTransitions,
    policy: Policy,
    initial_obs: Tensor,
    generator: torch.Generator,
) -> Weighting:
    """Train the two networks further and compute the weights of `replay` from them."""
    config = q.config
    metrics: dict[str, float] = {}
    if config.discriminator:
        ratio = RatioProblem.of(policy_buffer, replay, config)
        net, metrics = ratio.solve(discriminator, generator)
        log_ratio = ratio.log_ratio(net)
    else:
        log_ratio = membership_reward(replay, policy_buffer)
    scaling = Scaling.of((replay.obs, replay.action))
    problem = DualProblem(replay, log_ratio, initial_obs, policy, config, scaling)
    net, dual_metrics = problem.minimise(q, generator)
    terms = problem.terms(net, generator)
    raw, q_values = terms.raw(config), terms.now
    weighting = weighted(raw, log_ratio=log_ratio, clipped=True)
    start_gap = problem.start_gap(net, q_values, generator)
    metrics |= dual_metrics | {
        "dual/q_mean": float(q_values.mean()),
        "dual/start_gap": start_gap,
        "weights/raw_mean": float(raw.mean()),
    }
    # The discounted flow loses mass at ends, although KL's weights keep their sum.
    kl_drops_ends = divergence(config).normalised and config.flow == "discounted"
    conditions = (
        (RUNAWAY, start_gap > MAX_START_GAP),
        (ENDS_UNDER_KL, kl_drops_ends and bool(replay.terminated.any())),
    )
    notices = tuple(notice for notice, holds in conditions if holds)
    return replace(
        weighting,
        terms=terms if weighting.ready else None,
        metrics=metrics,
        notices=weighting.notices + notices,
    )


def occupancy_weights(
    buffer: Transitions,
    policy_buffer: Transitions,
    policy: Policy,
    initial_obs: Tensor | np.ndarray,
    config: TomConfig,
    generator: torch.Generator,
) -> Weighting:
    """Weights for `buffer` under which its rows look like the policy's own transitions.

    w = f*'(r + g E_{a'~pi}[Q(s', a')] - Q(s, a)) at the Q that minimises the dual (paper, eqs. 16
    and 17), scaled to mean 1. `buffer` holds N transitions, `policy_buffer` recent ones of the
    policy; both may be numpy arrays or tensors. `policy(obs, n, generator)` returns (n, B, A)
    actions for obs (B, O); with a method `support(obs) -> (actions (K, B, A), probs (K, B))` the
    expectation over a' is exact. `initial_obs` (M0, O) are draws of the start distribution. Both
    networks start anew; all randomness comes from `generator`, which is on the buffers' device.
    """
    replay, policy_rows = buffer.torch(), policy_buffer.torch()
    starts = torch.as_tensor(initial_obs).to(replay.obs)
    networks = _networks(replay.obs.shape[1], replay.action.shape[1], config, generator)
    return estimate(*networks, replay, policy_rows, policy, starts, generator)


def _networks(
    obs_dim: int, action_dim: int, config: TomConfig, generator: torch.Generator
) -> tuple[Discriminator, QFunction]:
    given = obs_dim, action_dim, config, generator
    return Discriminator(*given), QFunction(*given)


class TomLearner:
    """Occupancy weights; Q is trained further at every fit, or anew if episodes are held out.

    Uniform, and not ready, until the policy has taken `config.warmup` steps in the environment.
    """

    def __init__(
        self, config: TomConfig, obs_dim: int, action_dim: int, generator: torch.Generator
    ) -> None:
        self.config = config
        self.discriminator, self.q = _networks(obs_dim, action_dim, config, generator)

    def weigh(self, context: FitContext) -> Weighting:
        if context.on_policy_steps < self.config.warmup:
            return uniform(context.replay, ready=False)
        if self.config.discriminator_reset:
            self.discriminator.restart(self.discriminator.fresh(context.generator))
        if self.config.q_reset or self.config.q_holdout:  # an old Q has seen the held-out rows
            self.q.restart(self.q.fresh(context.generator))
        return estimate(
            self.discriminator,
            self.q,
            context.replay,
            context.policy_buffer,
            context.policy,
            context.initial_obs,
            context.generator,
        )

    def state_dict(self) -> dict[str, Any]:
        return {"discriminator": self.discriminator.state_dict(), "q": self.q.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.discriminator.load_state_dict(state["discriminator"])
        self.q.load_state_dict(state["q"])
