"""What acts on road-and-rocks: a linear model with known bounds and reward, and SAC."""

from dataclasses import replace

import torch
from torch import Tensor

from tom.config import SacConfig
from tom.data.transitions import TensorTransitions
from tom.dynamics.linear import LinearModel
from tom.learners.base import Weighting
from tom.policy.sac import Sac
from tom.road import task
from tom.road.task import ACTION_DIM, OBS_DIM


class RoadModel(LinearModel):
    """A linear model of the car; the bounds of the square and the reward are known."""

    def predict(self, obs: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        """The (reward (B,), next_obs (B, 2)) after obs (B, 2) and action (B, 2)."""
        next_obs = self.next_obs(obs, action).clamp(0, 1)
        return task.reward(next_obs), next_obs

    def sample(
        self, obs: Tensor, action: Tensor, generator: torch.Generator
    ) -> tuple[Tensor, Tensor]:
        """`predict`, as a `tom.dynamics.base.Sampled`: the linear model is deterministic."""
        return self.predict(obs, action)


def fit_linear(rows: TensorTransitions, weighting: Weighting) -> RoadModel:
    """The weighted fit; per dimension if the learner weighs dimensions."""
    by_dim = weighting.per_dim
    return RoadModel.fit(rows, weighting.weights if by_dim is None else by_dim)


SPREAD = 6.0


class RoadSac(Sac):
    """SAC over positions, which its networks see scaled: a `tom.learners.base.Policy`, too."""

    def __init__(self, config: SacConfig, generator: torch.Generator) -> None:
        super().__init__(OBS_DIM, ACTION_DIM, config, generator)

    def update(self, batch: TensorTransitions) -> dict[str, Tensor]:
        """One gradient step of everything on a (B, ...) batch; metrics (1,) each."""
        return super().update(replace(batch, obs=_seen(batch.obs), next_obs=_seen(batch.next_obs)))

    def __call__(self, obs: Tensor, n: int, generator: torch.Generator) -> Tensor:
        """n sampled actions for obs (B, 2): (n, B, 2)."""
        return self.policy(_seen(obs), n, generator)

    def mean(self, obs: Tensor) -> Tensor:
        """Mean actions (B, 2) for obs (B, 2)."""
        return self.policy.mean(_seen(obs))

    def value_gradient(self, obs: Tensor) -> Tensor:
        """dV_k/ds of both critics at positions (B, 2): (2, B, 2)."""
        return SPREAD * self.policy.value_gradient(_seen(obs))


def _seen(obs: Tensor) -> Tensor:
    return SPREAD * (obs - 0.5)
