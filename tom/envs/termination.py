"""Which next observations end an episode, for rollouts in a learnt model.

Each function maps next_obs (B, O) to a bool tensor (B,), with the bounds of Gymnasium's v5 task of
that name only. If the task tests a bound, a NaN ends the episode.
"""

from torch import Tensor


def never(next_obs: Tensor) -> Tensor:
    """Never ends."""
    return next_obs.new_zeros(len(next_obs)).bool()


def inverted_pendulum(next_obs: Tensor) -> Tensor:
    """Ends unless finite and |pole angle| <= 0.2 rad. obs = (cart x, pole angle, ...)."""
    return ~(next_obs.isfinite().all(dim=1) & (next_obs[:, 1].abs() <= 0.2))


def hopper(next_obs: Tensor) -> Tensor:
    """Ends unless finite, |obs[1:]| < 100, z > 0.7 and |angle| < 0.2. obs = (z, angle, ...).

    The bound on the state is two-sided; the released code has only the upper one.
    """
    z, angle = next_obs[:, 0], next_obs[:, 1]
    bounded = z.isfinite() & (next_obs[:, 1:].abs().amax(1) < 100)  # false for NaN
    return ~(bounded & (z > 0.7) & (angle.abs() < 0.2))


def walker2d(next_obs: Tensor) -> Tensor:
    """Ends unless 0.8 < z < 2.0 and |angle| < 1. obs = (z, angle, ...)."""
    z, angle = next_obs[:, 0], next_obs[:, 1]
    return ~((z > 0.8) & (z < 2.0) & (angle.abs() < 1.0))


def halfcheetah(next_obs: Tensor) -> Tensor:
    """Never ends."""
    return never(next_obs)


def ant(next_obs: Tensor) -> Tensor:
    """Ends unless finite and 0.2 <= z <= 1.0. obs = (z, ...)."""
    z = next_obs[:, 0]
    return ~(next_obs.isfinite().all(dim=1) & (z >= 0.2) & (z <= 1.0))


def humanoid(next_obs: Tensor) -> Tensor:
    """Ends unless 1.0 <= z <= 2.0 (Gymnasium leaves the two bounds out). obs = (z, ...)."""
    z = next_obs[:, 0]
    return ~((z >= 1.0) & (z <= 2.0))
