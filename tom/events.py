"""The events that a training yields to its consumers: recorder, progress bar, tests.

A training is a generator of events. It never waits for a consumer's files, clocks or sockets.
`env_step` counts environment steps (offline: steps of policy optimisation in the model).
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from tom.data.transitions import Transitions

FloatArray = NDArray[np.float32]


@dataclass(frozen=True)
class Tick:
    """One environment step is complete, or a longer phase of the work begins."""

    env_step: int
    phase: str  # "explore" and "optimise" end a step; "fit" and "evaluate" begin something longer

    @property
    def ends_step(self) -> bool:
        """Whether the training can be saved here (`state_dict`)."""
        return self.phase in ("explore", "optimise")


@dataclass(frozen=True)
class Metrics:
    """Scalars measured at `env_step`, keyed by metric path (see `tom.metrics.METRICS`)."""

    env_step: int
    values: dict[str, float]


@dataclass(frozen=True)
class Weights:
    """The weight of every transition in the replay buffer, oldest first, at a model fit.

    `weight` is (N,) and has mean 1 unless every weight is zero; `per_dim` is (N, O) for learners
    that weigh each dimension (then `weight` is its mean over dimensions). If the learner
    has a dual Q, `log_ratio` (N,) is its input r, and `terms` (N,) are the other terms of the
    weight (`tom.learners.terms`). `policy` is the policy of interest at this fit, as the arrays of
    `tom.policy.stored`. `rows` have been recorded so far, if these are not `env_step`.
    """

    env_step: int
    weight: FloatArray
    per_dim: FloatArray | None = None
    log_ratio: FloatArray | None = None
    terms: Mapping[str, FloatArray] = field(default_factory=dict)
    policy: Mapping[str, NDArray] | None = None
    rows: int | None = None


@dataclass(frozen=True)
class Episode:
    """One evaluation episode of H steps, complete enough to draw any frame of it again."""

    reward: FloatArray  # (H,)
    action: FloatArray  # (H, A)
    obs: FloatArray  # (H + 1, O)
    qpos: FloatArray | None = None  # (H + 1, nq), MuJoCo tasks only
    qvel: FloatArray | None = None  # (H + 1, nv), MuJoCo tasks only
    terminated: bool = False
    truncated: bool = False
    info: dict[str, float] = field(default_factory=dict)  # e.g. success

    @property
    def undiscounted_return(self) -> float:
        return float(self.reward.sum(dtype=np.float64))

    @property
    def length(self) -> int:
        return len(self.reward)


@dataclass(frozen=True)
class Evaluation:
    """The evaluation episodes of the policy at `env_step`, played in a separate environment."""

    env_step: int
    episodes: list[Episode]

    @property
    def mean_return(self) -> float:
        """Undiscounted, over the episodes."""
        return sum(e.undiscounted_return for e in self.episodes) / len(self.episodes)


@dataclass(frozen=True)
class Collected:
    """New rows of the replay buffer since the last such event, in the order of collection."""

    env_step: int
    transitions: Transitions
    policy_version: NDArray[np.int64]  # (n,) which policy collected each row; 0 is exploration
    state: Mapping[str, NDArray] = field(default_factory=dict)  # at obs: qpos (n, nq), qvel (n, nv)
    behaviour: FloatArray | None = None  # (n, 2 A), as in `ReplayBuffer`; None where nobody knows


@dataclass(frozen=True)
class Field:
    """Arrays of a task's own picture (road-and-rocks: map, model displacement field, ...)."""

    env_step: int
    name: str
    arrays: dict[str, NDArray]


@dataclass(frozen=True)
class Notice:
    """Something that a reader of the run must know (degenerate weights, a runaway dual Q)."""

    env_step: int
    kind: str
    message: str


@dataclass(frozen=True)
class TrainedPolicy:
    """The policy that a training ended with, as the arrays of `tom.policy.stored`."""

    env_step: int
    arrays: Mapping[str, NDArray]


@dataclass(frozen=True)
class KeptPolicy:
    """The policy as it stood at `env_step`, worth keeping; the arrays of `tom.policy.stored`."""

    env_step: int
    arrays: Mapping[str, NDArray]


Event = (
    Tick | Metrics | Weights | Evaluation | Collected | Field | Notice | KeptPolicy | TrainedPolicy
)
