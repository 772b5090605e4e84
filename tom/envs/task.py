"""The description of a task that a training needs without making the environment."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

import gymnasium as gym
import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:  # torch takes seconds to import, and who only shows runs does without it
    from torch import Tensor

Termination = Callable[["Tensor"], "Tensor"]
"""next_obs (B, O) -> terminated (B,), a bool tensor."""


@dataclass(frozen=True, kw_only=True)
class Task:
    """A task; agents act in [-1, 1].

    `terminated` ends modelled episodes; it is the task's own rule if `knows_ends`, else it never
    ends one. `steps` is the length of a training; `obs_names` names the O dimensions, and
    `action_names`, where they are known, the A of an action. A MuJoCo task has `nq` joint
    positions. With `root_dims` an observation is qpos without that many leading entries (the
    position on the ground), then qvel. With `keeps_states` observations have another form, and the
    simulator's state is recorded with every row. `settings` change the presets. `notices` (code and
    text) are about the task itself (`tom.data.card`).
    """

    name: str
    terminated: Termination
    steps: int
    action_dim: int
    obs_names: tuple[str, ...]
    action_names: tuple[str, ...] = ()
    max_episode_steps: int = 1000
    nq: int = 0
    root_dims: int | None = None
    knows_ends: bool = True
    keeps_states: bool = False
    of_paper: bool = False
    settings: Mapping[str, Any] = field(default_factory=dict)
    notices: tuple[tuple[str, str], ...] = ()

    @property
    def obs_dim(self) -> int:
        return len(self.obs_names)

    def make(self, seed: int | None = None) -> gym.Env[np.ndarray, np.ndarray]:
        """The environment, with actions in [-1, 1]; its random streams follow `seed`, if given."""
        raise NotImplementedError

    def described(self) -> dict[str, Any] | None:
        """The description for a run's `config.json`; None for a task of ours."""
        return None

    @cached_property
    def action_bounds(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """The least and the largest action, (A,) each, in the task's own units."""
        raise NotImplementedError

    def unit_action(self, action: NDArray) -> NDArray[np.float32]:
        """Actions (..., A) in the task's own units, rescaled to [-1, 1]."""
        low, high = (bound.astype(np.float64) for bound in self.action_bounds)
        return ((2 * action - (high + low)) / (high - low)).astype(np.float32)

    @property
    def obs_units(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Offset and scale (O,) of an observation in the task's own units."""
        return np.zeros(self.obs_dim), np.ones(self.obs_dim)

    def own_obs(self, obs: NDArray) -> NDArray[np.float64]:
        """Observations (..., O) as agents see them, in the task's own units."""
        offset, scale = self.obs_units
        return np.asarray(obs, np.float64) * scale + offset

    def unit_obs(self, obs: NDArray) -> NDArray[np.float32]:
        """Observations (..., O) in the task's own units, rescaled as agents see them."""
        offset, scale = self.obs_units
        return ((np.asarray(obs, np.float64) - offset) / scale).astype(np.float32)

    def qpos_from_obs(self, obs: np.ndarray) -> np.ndarray:
        """Joint positions (..., nq) of observations (..., O), with the root at the origin."""
        assert self.root_dims is not None, "observations of this task do not hold its joints"
        root = np.zeros((*obs.shape[:-1], self.root_dims), obs.dtype)
        return np.concatenate((root, obs[..., : self.nq - self.root_dims]), axis=-1)
