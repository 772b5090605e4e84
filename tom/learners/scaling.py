"""z-scores of what a network reads: each column by its mean and spread over the replay buffer."""

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
    def of(columns: Sequence[Tensor], change: tuple[Tensor, Tensor] | None = None) -> Scaling:
        """The scaling of groups of columns, (N, D_i) each, laid side by side.

        `change` is (after, before), (N, D) each: a last group, of the differences.
        """
        moments = [column_moments(group) for group in columns]
        if change:
            moments.append(column_moments(*change))
        std, mean = zip(*moments, strict=True)
        spread = torch.cat(std)
        return Scaling(
            torch.cat(mean), torch.where(spread < MIN_STD, torch.ones_like(spread), spread)
        )

    def first(self, n: int) -> Scaling:
        """The scaling of the first n columns alone."""
        return Scaling(self.mean[:n], self.std[:n])

    def __call__(self, x: Tensor) -> Tensor:
        return (x - self.mean) / self.std
