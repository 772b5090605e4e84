"""Why one transition of a replay buffer has its weight, and what follows from the weight.

The terms of its weight, the policy's own transitions nearest to it, how many rollouts start in it,
and where the model takes them.
"""

from dataclasses import dataclass

import torch
from torch import Tensor

from tom.config import RolloutConfig, TomConfig
from tom.data.scaling import Scaling
from tom.data.transitions import TensorTransitions
from tom.dynamics.base import Sampled
from tom.envs import Termination
from tom.learners.base import Policy, mixed_with_uniform
from tom.learners.terms import Terms, divergence


@dataclass(frozen=True)
class Sum:
    """One transition's weight = f*'(log_ratio + following + restart - now - level) / mean."""

    log_ratio: float  # r
    following: float  # g (1 - e) E_{a'~pi}[Q(s', a')]
    restart: float  # g e E_{mu0,pi}[Q(s0, a0)]
    now: float  # Q(s, a)
    level: float  # lambda
    raw: float  # f*' of the sum
    mean: float  # of raw over the buffer
    weight: float

    @property
    def argument(self) -> float:
        """y - lambda."""
        return self.log_ratio + self.following + self.restart - self.now - self.level


def sum_of(terms: Terms, config: TomConfig, row: int) -> Sum:
    """The terms of one row, and the level and mean shared by all rows.

    The sum is computed from the row's own numbers in float64, so it also checks the weight.
    """
    mean = float(terms.raw(config).mean(dtype=torch.float64))
    level = float(terms.level(config))
    parts = (terms.log_ratio, terms.following, terms.restart, terms.now)
    r, following, restart, now = (float(part[row]) for part in parts)
    z = torch.tensor(r + following + restart - now - level, dtype=torch.float64)
    raw = float(divergence(config).slope(z))
    return Sum(r, following, restart, now, level, raw, mean, raw / mean if mean else float("nan"))


@dataclass(frozen=True)
class Near:
    """The K nearest of M transitions, nearest first."""

    index: Tensor  # (K,) int64
    distance: Tensor  # (K,) standard deviations: root mean square over (s, a, s' - s)


def nearest(
    replay: TensorTransitions,
    row: int,
    others: TensorTransitions,
    count: int = 5,
    itself: int | None = None,
) -> Near:
    """The `others` nearest to a row of the buffer, in the buffer's z-scores of (s, a, s' - s).

    `itself`: the row's place among the others, if it is one of them; it is left out.
    """
    scaling = Scaling.of_moves(replay)
    here, there = (scaling(part.moves()) for part in (replay[row : row + 1], others))
    distance = (there - here).square().mean(1).sqrt()
    if itself is not None:
        distance[itself] = torch.inf
    left = len(others) - (itself is not None)
    closest = distance.topk(min(count, left), largest=False)
    return Near(closest.indices, closest.values)


def usual_distance(replay: TensorTransitions, others: TensorTransitions, rows: Tensor) -> float:
    """The median distance of these rows (K,) of the buffer to the nearest of the `others`."""
    scaling = Scaling.of_moves(replay)
    here, there = (scaling(part.moves()) for part in (replay[rows], others))
    nearest_of_each = torch.cdist(here, there).amin(1) / here.shape[1] ** 0.5
    return float(nearest_of_each.median())


def expected_starts(weights: Tensor, row: int, config: RolloutConfig) -> float:
    """The expected number of a round's rollouts that start in one row of weights (N,).

    Starts are drawn by weight if `rollout.weighted_starts` is set, else uniformly.
    """
    if not config.weighted_starts:
        return config.starts / len(weights)
    drawn_by = mixed_with_uniform(weights, config.uniform_share)
    return config.starts * float(drawn_by[row] / drawn_by.sum(dtype=torch.float64))


@torch.no_grad()
def rollouts(
    model: Sampled,
    policy: Policy,
    terminated: Termination,
    start: Tensor,
    steps: int,
    count: int,
    generator: torch.Generator,
) -> Tensor:
    """Rollouts of the policy in the model from one state (O,): (count, steps + 1, O).

    NaN after a rollout has ended or its numbers are no longer finite.
    """
    obs = start.expand(count, -1).clone()
    seen, alive = [obs], torch.ones(count, dtype=torch.bool)
    for _ in range(steps):
        action = policy(obs, 1, generator)[0]
        _, following = model.sample(obs, action, generator)
        finite = following.isfinite().all(1)
        seen.append(torch.where((alive & finite)[:, None], following, torch.nan))
        alive = alive & finite & ~terminated(following)
        obs = torch.where(alive[:, None], following, obs)
    return torch.stack(seen, 1)
