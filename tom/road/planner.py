"""Planning in a learnt model by value iteration on a grid over the unit square, with known reward.

It is cheap and has no optimisation noise, so its return in the real task measures only the model.
"""

from collections.abc import Callable

import torch
from torch import Tensor

GRID = 51
"""values are computed at GRID x GRID states and interpolated between them"""
LEVELS = 9
"""number of values tried in each action dimension"""
SWEEPS = 400
TOLERANCE = 1e-4


def interpolation(obs: Tensor) -> Callable[[Tensor], Tensor]:
    """Bilinear interpolation at B states (B, 2): from a table (GRID^2,) the values (B,)."""
    scaled = obs.clamp(0, 1) * (GRID - 1)
    low = scaled.floor().clamp(max=GRID - 2)
    (x, y), (u, v) = low.long().unbind(-1), (scaled - low).unbind(-1)
    first = y * GRID + x
    index = torch.stack([first, first + 1, first + GRID, first + GRID + 1])  # (4, B)
    share = torch.stack([(1 - u) * (1 - v), u * (1 - v), (1 - u) * v, u * v])
    return lambda value: (share * value[index]).sum(0)


def planned(
    predict: Callable[[Tensor, Tensor], Tensor],
    reward: Callable[[Tensor], Tensor],
    terminated: Callable[[Tensor], Tensor],
    discount: float,
) -> tuple[Tensor, Callable[[Tensor], Tensor]]:
    """V (GRID^2,), row by row, and the greedy policy: actions (B, 2) for obs (B, 2).

    V(s) = max_a r(s') + discount (1 - terminated(s')) V(s'), where `predict` is next_obs (B, 2)
    after obs and action, and the other two are of next_obs.
    """
    levels = torch.linspace(-1, 1, LEVELS)
    tried = torch.cartesian_prod(levels, levels)

    def look_ahead(obs: Tensor) -> Callable[[Tensor], Tensor]:
        """From a table of values, Q of every action at obs (B, 2): (LEVELS^2, B)."""
        next_obs = predict(obs.repeat(len(tried), 1), tried.repeat_interleave(len(obs), 0)).clamp(
            0, 1
        )
        gain, read = reward(next_obs), interpolation(next_obs)
        alive = discount * (1 - terminated(next_obs).float())
        return lambda value: (gain + alive * read(value)).view(len(tried), len(obs))

    axis = torch.linspace(0, 1, GRID)
    y, x = torch.meshgrid(axis, axis, indexing="ij")
    ahead, value = look_ahead(torch.stack([x, y], -1).reshape(-1, 2)), torch.zeros(GRID * GRID)
    for _ in range(SWEEPS):
        before, value = value, ahead(value).amax(0)
        if float((value - before).abs().max()) < TOLERANCE:
            break
    return value, lambda obs: tried[look_ahead(obs)(value).argmax(0)]
