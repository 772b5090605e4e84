"""The interface of a learner: a weighting of the replay buffer.

All learners fit the same dynamics model by weighted maximum likelihood; they differ only in the
weight of each transition (and dimension).
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

import torch
from numpy.typing import NDArray
from torch import Tensor

from tom.config import ModelConfig, RolloutConfig
from tom.data.sampling import normalise
from tom.data.transitions import TensorTransitions
from tom.events import FloatArray, Weights
from tom.learners.terms import Terms


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
    """Actions (K, B, A) and probabilities (K, B) for a ~ pi(.|obs): all actions, or n draws."""
    if isinstance(policy, FinitePolicy):
        actions, probs = policy.support(obs)
    else:
        actions = policy(obs, n, generator)
        probs = obs.new_full(actions.shape[:2], 1.0 / len(actions))
    return actions.detach().to(obs), probs.detach().to(obs)


@dataclass(frozen=True)
class FitContext:
    """The information that a learner may use before a model fit.

    `replay` is the whole replay buffer, oldest first; `policy_version` says which policy
    collected each row (0 is exploration); `policy_buffer` holds the last on-policy transitions
    and `on_policy_steps` counts how many there have been; `initial_obs` are draws of the start
    distribution mu_0. `value_gradient` gives dV_k/ds of the K value heads at (B, O) states,
    (K, B, O), where the policy optimiser has value heads. `behaviour` is the Gaussian that each
    row's action was drawn from (`ReplayBuffer.behaviour`), where the data has it. `model_errors`
    gives the last model's error at each row (N,), once there is a model.
    """

    replay: TensorTransitions
    policy_version: Tensor  # (N,) int64
    policy_buffer: TensorTransitions
    on_policy_steps: int
    initial_obs: Tensor  # (M0, O)
    policy: Policy
    generator: torch.Generator
    value_gradient: Callable[[Tensor], Tensor] | None = None
    behaviour: Tensor | None = None  # (N, 2 A)
    model_errors: Callable[[], Tensor] | None = None


@dataclass(frozen=True)
class Weighting:
    """A learner's result: one weight per transition, normalised to mean 1.

    `ready` is False as long as the learner cannot compute weights (they are uniform then).
    `clipped`: the fit clips them, but the rollouts' start states and the record do not.
    `notices` are (kind, message) pairs for the run's record.
    """

    weights: Tensor  # (N,)
    per_dim: Tensor | None = None  # (N, O)
    log_ratio: Tensor | None = None  # (N,)
    terms: Terms | None = None  # their sum determines the weights, if they come from a dual Q
    ready: bool = True
    clipped: bool = False
    metrics: Mapping[str, float] = field(default_factory=dict)
    notices: tuple[tuple[str, str], ...] = ()

    @property
    def row_weights(self) -> Tensor:
        """The weights for drawing rows, (N,): ones if per-dimension weights scale the loss.

        A weight that both drew a row and scaled its loss would count twice.
        """
        return self.weights if self.per_dim is None else torch.ones_like(self.weights)

    def for_fit(self, config: ModelConfig) -> tuple[Tensor, Tensor | None]:
        """The rows' weights (N,) and the dimensions' (N, O) for a fit of the model.

        Clipped if `clipped`, then mixed with the uniform share. Clipped weights have a mean m below
        1, so that of the draws c / (c + (1 - c) m) are uniform for a share c, more than c.
        """
        rows, share = self.row_weights, config.uniform_share
        rows = rows.clamp(max=config.weight_clip) if self.clipped else rows
        per_dim = None if self.per_dim is None else mixed_with_uniform(self.per_dim, share)
        return mixed_with_uniform(rows, share), per_dim

    def counted(self, config: ModelConfig) -> Tensor:
        """The weight of each row in that fit, (N,), averaged over its dimensions."""
        rows, per_dim = self.for_fit(config)
        return rows if per_dim is None else per_dim.mean(1)

    def for_starts(self, config: RolloutConfig) -> Tensor | None:
        """The weights (N,) for drawing start states of rollouts; None for uniform draws."""
        if not config.weighted_starts or not self.ready:
            return None
        return mixed_with_uniform(self.row_weights, config.uniform_share)

    def event(
        self,
        env_step: int,
        policy: Mapping[str, NDArray] | None = None,
        rows: int | None = None,
    ) -> Weights:
        """The event for a fit with these weights; `policy` and `rows` as in `Weights`."""

        def array(x: Tensor) -> FloatArray:
            return x.to("cpu", torch.float32).numpy()

        return Weights(
            env_step,
            weight=array(self.weights),
            per_dim=None if self.per_dim is None else array(self.per_dim),
            log_ratio=None if self.log_ratio is None else array(self.log_ratio),
            terms={}
            if self.terms is None
            else {name: array(term) for name, term in self.terms.recorded().items()},
            policy=policy,
            rows=rows,
        )


def mixed_with_uniform(weights: Tensor, share: float) -> Tensor:
    """The defensive mixture share + (1 - share) w of weights with mean 1: none is below `share`.

    With w = p/q, a uniform share bounds how much a row of p can lose (Hesterberg 1995).
    """
    return share + (1 - share) * weights if share else weights


def heavy_row(starts: Tensor | None) -> tuple[tuple[str, str], ...]:
    """A notice if a single row has HEAVY or more of the starts' weights (N,); None is uniform."""
    if starts is None:
        return ()
    share = float(starts.max() / starts.sum(dtype=torch.float64))
    if share < HEAVY:
        return ()
    message = (
        f"{100 * share:.0f} % of the rollouts start from one row of {len(starts)}, which has that "
        "share of the weight: --rollout.uniform-share S starts a share S of them anywhere"
    )
    return (("heavy-row", message),)


def uniform(replay: TensorTransitions, ready: bool) -> Weighting:
    """Weight one for every transition of `replay`."""
    return Weighting(torch.ones(len(replay), device=replay.obs.device), ready=ready)


def weighted(raw: Tensor, **others: Any) -> Weighting:
    """Weights (N,) of any mean, scaled to 1; uniform, with a notice, if they are degenerate.

    `others` are further fields of the `Weighting`.
    """
    weights, degenerate = normalise(raw)
    notices = (DEGENERATE,) if degenerate else ()
    return Weighting(weights, ready=not degenerate, notices=notices, **others)


DEGENERATE = (
    "degenerate-weights",
    "every weight is zero, or some weight is negative or not finite: this fit uses uniform weights",
)
"""kind of the notice about unusable weights"""
HEAVY = 0.1
"""the share of the weight from which on one row's is told"""


class Learner(Protocol):
    """A model learner. It may keep networks between fits; `state_dict` holds all of its state."""

    def weigh(self, context: FitContext) -> Weighting:
        """The weights of the N transitions in `context.replay`, for the fit that follows."""
        ...

    def state_dict(self) -> dict[str, Any]:
        """Tensors and primitives that determine all later weights; empty if nothing is kept."""
        ...

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Continue from `state_dict`."""
        ...


class Stateless:
    """A learner that keeps nothing between fits."""

    def state_dict(self) -> dict[str, Any]:
        return {}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        pass
