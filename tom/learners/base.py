"""What a learner is: a weighting of the replay buffer.

Every learner fits the same dynamics model by weighted maximum likelihood; they differ only in
the answer to one question: how much does each transition (and dimension) count?
"""

from collections.abc import Callable, Generator, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

import torch
from numpy.typing import NDArray
from torch import Tensor

from tom.config import ModelConfig, RolloutConfig
from tom.data.transitions import TensorTransitions
from tom.events import FloatArray, Weights
from tom.nn.lockstep import Work


class Policy(Protocol):
    """A stochastic policy: n actions for each observation. It may be a `FinitePolicy`, too."""

    def __call__(self, obs: Tensor, n: int, generator: torch.Generator) -> Tensor:
        """obs (B, O) -> actions (n, B, A)."""
        ...


@runtime_checkable
class FinitePolicy(Protocol):
    """A policy with finitely many actions, which makes expectations over a' exact."""

    def support(self, obs: Tensor) -> tuple[Tensor, Tensor]:
        """obs (B, O) -> actions (K, B, A) and their probabilities (K, B)."""
        ...


def policy_actions(
    policy: Policy, obs: Tensor, n: int, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Actions (K, B, A) and probabilities (K, B) that stand for a ~ pi(.|obs): all, or n draws."""
    if isinstance(policy, FinitePolicy):
        actions, probs = policy.support(obs)
    else:
        actions = policy(obs, n, generator)
        probs = obs.new_full(actions.shape[:2], 1.0 / len(actions))
    return actions.detach().to(obs), probs.detach().to(obs)


@dataclass(frozen=True)
class FitContext:
    """All that a learner may look at when the model is about to be fitted.

    `replay` is the whole replay buffer, oldest first; `policy_version` says which policy
    collected each row (0 is exploration); `policy_buffer` holds the last on-policy transitions
    and `on_policy_steps` counts how many there have been; `initial_obs` are draws of the start
    distribution mu_0. `value_gradient` gives dV_k/ds of the K value heads at (B, O) states,
    (K, B, O), where the policy optimiser has value heads.
    """

    replay: TensorTransitions
    policy_version: Tensor  # (N,) int64
    policy_buffer: TensorTransitions
    on_policy_steps: int
    initial_obs: Tensor  # (M0, O)
    policy: Policy
    generator: torch.Generator
    value_gradient: Callable[[Tensor], Tensor] | None = None


@dataclass(frozen=True)
class Weighting:
    """The answer: one weight a transition, normalised to mean 1.

    `ready` is False while the learner has nothing to say yet (its weights are uniform then);
    `clipped` says that the fit clips them, which rollouts' start states and records do not.
    `notices` are (kind, message) pairs that belong into the run's record.
    """

    weights: Tensor  # (N,)
    per_dim: Tensor | None = None  # (N, O)
    log_ratio: Tensor | None = None  # (N,)
    ready: bool = True
    clipped: bool = False
    metrics: Mapping[str, float] = field(default_factory=dict)
    notices: tuple[tuple[str, str], ...] = ()

    @property
    def row_weights(self) -> Tensor:
        """What rows are drawn by, (N,): ones where the dimensions' weights scale the loss.

        A weight that drew a row and scaled its loss as well would count squared.
        """
        return self.weights if self.per_dim is None else torch.ones_like(self.weights)

    def for_fit(self, config: ModelConfig) -> tuple[Tensor, Tensor | None]:
        """The rows' weights (N,) and the dimensions' (N, O) for a fit of the model.

        Clipped where they are to be, then mixed with the uniform share.
        """
        rows, share = self.row_weights, config.uniform_share
        rows = rows.clamp(max=config.weight_clip) if self.clipped else rows
        per_dim = None if self.per_dim is None else mixed_with_uniform(self.per_dim, share)
        return mixed_with_uniform(rows, share), per_dim

    def counted(self, config: ModelConfig) -> Tensor:
        """How much each row counts in that fit, (N,), on average over its dimensions."""
        rows, per_dim = self.for_fit(config)
        return rows if per_dim is None else per_dim.mean(1)

    def for_starts(self, config: RolloutConfig) -> Tensor | None:
        """The weights (N,) by which start states of rollouts are drawn; None: uniformly."""
        if not config.weighted_starts or not self.ready:
            return None
        return mixed_with_uniform(self.row_weights, config.uniform_share)

    def event(self, env_step: int, policy: Mapping[str, NDArray] | None = None) -> Weights:
        """What a training tells of a fit by these weights; `policy` as in `Weights`."""

        def array(x: Tensor) -> FloatArray:
            return x.to("cpu", torch.float32).numpy()

        return Weights(
            env_step,
            weight=array(self.weights),
            per_dim=None if self.per_dim is None else array(self.per_dim),
            log_ratio=None if self.log_ratio is None else array(self.log_ratio),
            policy=policy,
        )


def mixed_with_uniform(weights: Tensor, share: float) -> Tensor:
    """The defensive mixture share + (1 - share) w of weights with mean 1: none is below `share`.

    With w = p/q a uniform share bounds by how much a row of p may be starved (Hesterberg 1995).
    """
    return share + (1 - share) * weights if share else weights


def uniform(replay: TensorTransitions, ready: bool) -> Weighting:
    """Weight one for every transition of `replay`."""
    return Weighting(torch.ones(len(replay), device=replay.obs.device), ready=ready)


DEGENERATE = (
    "degenerate-weights",
    "every weight is zero or some weight is not finite: this fit uses uniform weights",
)
"""The notice of a fit whose weights were unusable."""


def weighing(learner: "Learner", context: FitContext) -> Generator[Work, None, Weighting]:
    """What `learner.weigh` answers, its trainings as work that a fleet may do in one go."""
    if isinstance(learner, LearnerWithWork):
        return (yield from learner.weighing(context))
    return learner.weigh(context)


@runtime_checkable
class LearnerWithWork(Protocol):
    """A learner that trains networks of its own at every fit."""

    def weighing(self, context: FitContext) -> Generator[Work, None, Weighting]: ...


class Learner(Protocol):
    """A model learner. It keeps what it warm-starts; `state_dict` is all of that."""

    def weigh(self, context: FitContext) -> Weighting: ...

    def state_dict(self) -> dict[str, Any]: ...

    def load_state_dict(self, state: dict[str, Any]) -> None: ...
