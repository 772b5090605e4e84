"""The current policy beside the one that drew each row's action, without a network to train.

Both are Gaussians that tanh squashes (soft actor-critic's). tanh is one-to-one, so their divergence
and their ratio are those of the Gaussians before it. Exploration (policy version 0) drew uniformly
from [-1, 1].
"""

from dataclasses import dataclass
from math import log
from typing import Protocol, runtime_checkable

import torch
from torch import Tensor
from torch.nn.functional import softplus

from tom.errors import UserError
from tom.learners.base import FitContext
from tom.nn.mlp import rows_at_once

CHUNK = 1024  # rows evaluated at once; they stay in the processor's cache
LARGEST = 1 - 2.0**-24
"""actions beyond it, rounded to 1 in single precision, are taken for it"""
MISSING = (
    "{lacking} of {of} rows do not say which policy drew their action: runs and recordings made "
    "since 2026-11-27 do; a dataset needs columns behaviour_mean and behaviour_log_std, or "
    "--collected-by POLICY ..."
)


@runtime_checkable
class GaussianPolicy(Protocol):
    """A policy whose actions are draws of a Gaussian that tanh squashes."""

    def gaussian(self, obs: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and log standard deviation before tanh for obs (B, O): (B, A) each."""
        ...


@dataclass(frozen=True)
class Behaviour:
    """The policies now and then at the state of each of K rows, (K, A) each."""

    mean: Tensor
    log_std: Tensor
    mean_then: Tensor  # NaN in exploration, as the next
    log_std_then: Tensor
    explored: Tensor  # (K,) bool

    @staticmethod
    def of(context: FitContext, rows: Tensor) -> "Behaviour":
        """Those of `rows` (N,) bool of the replay. Raises UserError (`require_behaviour`)."""
        obs, then = context.replay.obs[rows], context.behaviour
        policy = require_behaviour(context.policy_version, then, context.policy)
        explored = explored_rows(context)[rows]
        size = rows_at_once(obs.device, CHUNK)
        with torch.no_grad():
            parts = [policy.gaussian(part) for part in obs.split(size)]
        mean, log_std = (torch.cat(each) for each in zip(*parts, strict=True))
        if then is None:  # exploration alone
            then = obs.new_full((len(rows), 2 * mean.shape[1]), torch.nan)
        mean_then, log_std_then = then.to(obs)[rows].chunk(2, 1)
        return Behaviour(mean, log_std, mean_then, log_std_then, explored)

    def divergence(self) -> Tensor:
        """KL(pi_now(.|s) || pi_then(.|s)) in nats, (K,); NaN in exploration."""
        wider = self.log_std_then - self.log_std
        apart = (self.mean - self.mean_then) * (-self.log_std_then).exp()
        return (wider + 0.5 * ((-2 * wider).exp() + apart.square() - 1)).sum(1)

    def log_ratio(self, action: Tensor) -> Tensor:
        """log pi_now(a|s) - log pi_then(a|s) for actions (K, A) in [-1, 1]: (K,)."""
        u = torch.atanh(action.clamp(-LARGEST, LARGEST))
        now = _log_normal(u, self.mean, self.log_std)
        # The slope of tanh, log(1 - a^2), is in both but where exploration's density is 1/2.
        log_slope = 2.0 * (log(2.0) - u - softplus(-2.0 * u))
        uniform = log_slope + log(0.5) + 0.5 * log(2 * torch.pi)
        then = _log_normal(u, self.mean_then, self.log_std_then)
        return (now - torch.where(self.explored[:, None], uniform, then)).sum(1)


def explored_rows(context: FitContext) -> Tensor:
    """The rows that exploration collected, (N,) bool."""
    return context.policy_version.to(context.replay.obs.device) == 0


def require_behaviour(
    policy_version: Tensor, behaviour: Tensor | None, policy: object
) -> GaussianPolicy:
    """The policy of interest, if it and those that collected the rows are known as Gaussians.

    Raises UserError if `behaviour` (N, 2 A) lacks rows that are not exploration.
    """
    lacks = policy_version != 0
    if behaviour is not None:
        lacks = lacks.to(behaviour.device) & ~behaviour.isfinite().all(1)
    if lacking := int(lacks.sum()):
        raise UserError(MISSING.format(lacking=lacking, of=len(lacks)))
    if not isinstance(policy, GaussianPolicy):
        raise UserError(
            "the policy of interest does not give mean and log_std, which its distance to others "
            "needs: name another policy or another learner"
        )
    return policy


def _log_normal(u: Tensor, mean: Tensor, log_std: Tensor) -> Tensor:
    """The logarithm of a normal density, up to log(2 pi) / 2, elementwise."""
    return -0.5 * ((u - mean) * (-log_std).exp()).square() - log_std
