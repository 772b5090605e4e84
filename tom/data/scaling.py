"""z-scores of a network's inputs or targets, by the mean and spread of a buffer's columns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from tom.data.transitions import TensorTransitions

MIN_STD = 1e-6
"""a column is constant, centred and left unscaled, if its spread is below this, and below
`ROUNDING` of its mean or `NOTHING`"""
ROUNDING, NOTHING = 1e-4, 1e-12
AT_ONCE = 4  # columns gathered at once, which bounds the memory to a few columns


@dataclass(frozen=True)
class Scaling:
    """Column means and standard deviations, (D,) each."""

    mean: Tensor
    std: Tensor

    @staticmethod
    def of(
        columns: Sequence[Tensor],
        change: tuple[Tensor, Tensor] | None = None,
        rows: Tensor | None = None,
    ) -> Scaling:
        """The scaling of groups of columns, (N, D_i) each, concatenated.

        `change` is (after, before), (N, D) each, and adds a last group, their difference. If given,
        only `rows` (n,) are used for the moments.
        """
        moments = [column_moments(group, rows=rows) for group in columns]
        if change:
            moments.append(column_moments(*change, rows))
        std, mean = zip(*moments, strict=True)
        spread, centre = torch.cat(std), torch.cat(mean)
        constant = (spread < MIN_STD) & (spread < (ROUNDING * centre.abs()).clamp(min=NOTHING))
        return Scaling(centre, torch.where(constant, torch.ones_like(spread), spread))

    @staticmethod
    def of_moves(rows: TensorTransitions) -> Scaling:
        """The scaling of `rows.moves()`, (s, a, s' - s)."""
        return Scaling.of((rows.obs, rows.action), (rows.next_obs, rows.obs))

    @staticmethod
    def identity(dim: int, device: torch.device) -> Scaling:
        """The scaling of `dim` columns that leaves them as they are."""
        return Scaling(torch.zeros(dim, device=device), torch.ones(dim, device=device))

    def first(self, n: int) -> Scaling:
        return Scaling(self.mean[:n], self.std[:n])

    def to(self, device: torch.device) -> Scaling:
        return Scaling(self.mean.to(device), self.std.to(device))

    def __call__(self, x: Tensor) -> Tensor:
        """Columns (..., D) as z-scores."""
        return (x - self.mean) / self.std

    def inverse(self, z: Tensor) -> Tensor:
        """The columns (..., D) with these z-scores."""
        return z * self.std + self.mean


def column_moments(
    columns: Tensor, minus: Tensor | None = None, rows: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Standard deviation and mean, (D,) each, of the columns of a table (N, D).

    If given, `minus` (N, D) is subtracted first and only `rows` (n,) are used.
    """

    def moments(part: slice) -> tuple[Tensor, Tensor]:
        chosen = columns[:, part] if minus is None else columns[:, part] - minus[:, part]
        return torch.std_mean(chosen if rows is None else chosen[rows], 0, correction=0)

    starts = range(0, columns.shape[1], AT_ONCE)
    std, mean = zip(*(moments(slice(i, i + AT_ONCE)) for i in starts), strict=True)
    return torch.cat(std), torch.cat(mean)
