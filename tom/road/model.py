"""The dynamics model of road-and-rocks: linear, with known bounds and reward."""

import torch
from torch import Tensor

from tom.data.transitions import TensorTransitions
from tom.dynamics.linear import LinearModel
from tom.learners.base import Weighting
from tom.road import task


class RoadModel:
    """A linear model of the car; the bounds of the square and the reward are known."""

    def __init__(self, linear: LinearModel) -> None:
        self.linear = linear

    def predict(self, obs: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """The (reward (B,), next_obs (B, 2)) after obs (B, 2) and action (B, 2)."""
        next_obs = self.linear.next_obs(obs, action).clamp(0, 1)
        return task.reward(next_obs), next_obs

    def sample(
        self, obs: Tensor, action: Tensor, generator: torch.Generator
    ) -> tuple[Tensor, Tensor]:
        """`predict`, as a `tom.policy.rollout.RolloutModel`: the linear model is deterministic."""
        return self.predict(obs, action)


def fit_linear(rows: TensorTransitions, weighting: Weighting) -> LinearModel:
    """The weighted fit; per dimension if the learner weighs dimensions."""
    by_dim = weighting.per_dim
    return LinearModel.fit(rows, weighting.weights if by_dim is None else by_dim)
