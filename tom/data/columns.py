"""Moments of a buffer's columns, without a copy of the buffer."""

from collections.abc import Callable

import torch
from torch import Tensor

AT_ONCE = 4  # columns gathered at once: as much memory as a few rows of a large buffer


def column_moments(columns: Callable[[slice], Tensor], dim: int) -> tuple[Tensor, Tensor]:
    """Standard deviation and mean (dim,) of columns that are asked for a few at a time.

    `columns(part)` gives those columns, (N, up to AT_ONCE).
    """
    parts = [
        torch.std_mean(columns(slice(i, min(i + AT_ONCE, dim))), 0, correction=0)
        for i in range(0, dim, AT_ONCE)
    ]
    std, mean = zip(*parts, strict=True)
    return torch.cat(std), torch.cat(mean)
