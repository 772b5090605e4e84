"""Planning in a learnt model by value iteration on a grid over the unit square, with known reward.

It is cheap and has no optimisation noise, so its return in the real task measures only the model.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

Predict = Callable[[Tensor, Tensor], Tensor]
"""next_obs (B, 2) after obs (B, 2) and action (B, 2)."""
Judge = Callable[[Tensor], Tensor]
"""A number or flag (B,) of each next_obs (B, 2)."""

GRID = 51
"""values are computed at GRID x GRID states and interpolated between them"""
LEVELS = 9
"""number of values tried in each action dimension"""
SWEEPS = 400
TOLERANCE = 1e-4


@dataclass(frozen=True)
class Corners:
    """Bilinear interpolation at B states: four points of the grid and their shares."""

    index: Tensor  # (4, B)
    share: Tensor  # (4, B)

    @staticmethod
    def of(obs: Tensor) -> "Corners":
        scaled = obs.clamp(0, 1) * (GRID - 1)
        low = scaled.floor().clamp(max=GRID - 2)
        (x, y), (u, v) = low.long().unbind(-1), (scaled - low).unbind(-1)
        first = y * GRID + x
        index = torch.stack([first, first + 1, first + GRID, first + GRID + 1])
        return Corners(index, torch.stack([(1 - u) * (1 - v), u * (1 - v), (1 - u) * v, u * v]))

    def read(self, value: Tensor) -> Tensor:
        """The interpolated values (B,) of a table (GRID^2,)."""
        return (self.share * value[self.index]).sum(0)


@dataclass(frozen=True)
class Planner:
    """A model, the known parts of the task, and the discount."""

    predict: Predict
    reward: Judge
    terminated: Judge
    discount: float

    def value(self) -> Tensor:
        """V (GRID^2,), row by row: V(s) = max_a r(s') + discount (1 - terminated(s')) V(s')."""
        axis = torch.linspace(0, 1, GRID)
        y, x = torch.meshgrid(axis, axis, indexing="ij")
        ahead = self._look_ahead(torch.stack([x, y], -1).reshape(-1, 2))
        value = torch.zeros(GRID * GRID)
        for _ in range(SWEEPS):
            before, value = value, ahead(value).amax(0)
            if float((value - before).abs().max()) < TOLERANCE:
                break
        return value

    def steering(self) -> Callable[[Tensor], Tensor]:
        """The greedy policy: actions (B, 2) for obs (B, 2)."""
        value, tried = self.value(), actions()

        def steer(obs: Tensor) -> Tensor:
            return tried[self._look_ahead(obs)(value).argmax(0)]

        return steer

    def _look_ahead(self, obs: Tensor) -> Callable[[Tensor], Tensor]:
        """Values table (GRID^2,) -> Q of every action at obs (B, 2): (LEVELS^2, B)."""
        tried = actions()
        shape = (len(tried), len(obs))
        next_obs = self.predict(
            obs.repeat(len(tried), 1), tried.repeat_interleave(len(obs), 0)
        ).clamp(0, 1)
        reward = self.reward(next_obs)
        alive = self.discount * (1 - self.terminated(next_obs).float())
        corners = Corners.of(next_obs)
        return lambda value: (reward + alive * corners.read(value)).view(shape)


def actions() -> Tensor:
    """The actions that are tried, (LEVELS^2, 2)."""
    levels = torch.linspace(-1, 1, LEVELS)
    return torch.cartesian_prod(levels, levels)
