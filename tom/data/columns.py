"""Moments of a buffer's columns, without a copy of the buffer."""

import torch
from torch import Tensor

AT_ONCE = 4  # columns gathered at once: no more memory than a few columns of the buffer


def column_moments(
    columns: Tensor, minus: Tensor | None = None, rows: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Standard deviation and mean, (D,) each, of the columns of a table (N, D).

    Of the table's difference to `minus` (N, D), and of the rows (n,) alone, where they are given.
    """

    def moments(part: slice) -> tuple[Tensor, Tensor]:
        found = columns[:, part] if minus is None else columns[:, part] - minus[:, part]
        return torch.std_mean(found if rows is None else found[rows], 0, correction=0)

    starts = range(0, columns.shape[1], AT_ONCE)
    std, mean = zip(*(moments(slice(i, i + AT_ONCE)) for i in starts), strict=True)
    return torch.cat(std), torch.cat(mean)
