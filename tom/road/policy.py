"""SAC for road-and-rocks, whose networks read centred and scaled positions.

Raw positions in the unit square differ too little between road and rocks: SAC then needs several
times the updates.
"""

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from tom.config import SacConfig
from tom.data.transitions import TensorTransitions
from tom.policy.sac import Sac
from tom.road.task import ACTION_DIM, OBS_DIM

SPREAD = 6.0


class RoadSac:
    """One SAC as a policy over positions (a `tom.learners.base.Policy`) and its optimiser."""

    def __init__(self, config: SacConfig, generator: torch.Generator) -> None:
        self._sac = Sac(OBS_DIM, ACTION_DIM, config, generator)
        self._policy = self._sac.policy

    def update(self, rows: TensorTransitions) -> dict[str, Tensor]:
        """One gradient step of everything on a (B, ...) batch; metrics (1,) each."""
        seen = replace(rows, obs=_seen(rows.obs), next_obs=_seen(rows.next_obs))
        return self._sac.update(seen)

    def state_dict(self) -> dict[str, Any]:
        return self._sac.state_dict()

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self._sac.load_state_dict(state)

    def __call__(self, obs: Tensor, n: int, generator: torch.Generator) -> Tensor:
        """n sampled actions for obs (B, 2): (n, B, 2)."""
        return self._policy(_seen(obs), n, generator)

    def mean(self, obs: Tensor) -> Tensor:
        """Mean actions (B, 2) for obs (B, 2)."""
        return self._policy.mean(_seen(obs))

    def value_gradient(self, obs: Tensor) -> Tensor:
        """dV_k/ds of both critics at positions (B, 2): (2, B, 2)."""
        return SPREAD * self._policy.value_gradient(_seen(obs))


def _seen(obs: Tensor) -> Tensor:
    return SPREAD * (obs - 0.5)
