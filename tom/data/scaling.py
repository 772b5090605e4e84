"""z-scores of what a network reads or predicts, by the mean and spread of a buffer's columns."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from tom.data.columns import column_moments

MIN_STD = 1e-6  # a constant column is centred and left unscaled


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
        """The scaling of groups of columns, (N, D_i) each, laid side by side.

        `change` is (after, before), (N, D) each: a last group, of the differences. By the moments
        of the rows (n,) alone, where they are given.
        """
        moments = [column_moments(group, rows=rows) for group in columns]
        if change:
            moments.append(column_moments(*change, rows))
        std, mean = zip(*moments, strict=True)
        spread = torch.cat(std)
        return Scaling(
            torch.cat(mean), torch.where(spread < MIN_STD, torch.ones_like(spread), spread)
        )

    @staticmethod
    def identity(dim: int, device: torch.device) -> Scaling:
        """The scaling of `dim` columns that changes nothing."""
        return Scaling(torch.zeros(dim, device=device), torch.ones(dim, device=device))

    def first(self, n: int) -> Scaling:
        """The scaling of the first n columns alone."""
        return Scaling(self.mean[:n], self.std[:n])

    def to(self, device: torch.device) -> Scaling:
        """The same on `device`."""
        return Scaling(self.mean.to(device), self.std.to(device))

    def __call__(self, x: Tensor) -> Tensor:
        """Columns (..., D) as z-scores."""
        return (x - self.mean) / self.std

    def inverse(self, z: Tensor) -> Tensor:
        """z-scores (..., D) as the columns they are of."""
        return z * self.std + self.mean
