"""Draw rows of a buffer: by weight, uniformly, whole episodes; normalise and summarise weights."""

import numpy as np
import torch
from torch import Tensor

from tom.data.transitions import TensorTransitions

FEW = 10  # with fewer episodes than this, blocks of rows are held out instead
BLOCK = 100  # rows


def normalise(weights: Tensor) -> tuple[Tensor, bool]:
    """Weights (N,) scaled to mean 1, and whether they were degenerate.

    Degenerate weights (all zero, or any negative or non-finite one) become uniform.
    """
    total = weights.sum(dtype=torch.float64)
    if not _are_usable(weights, total):
        return torch.ones_like(weights), True
    return (weights.to(torch.float64) * (len(weights) / total)).to(weights.dtype), False


class WeightedSampler:
    """Draws row numbers with replacement, row i in proportion to weights[i].

    Inverse of the cumulative sum in float64: `torch.multinomial` fails above 2^24 rows. Raises
    ValueError for weights that are negative, not finite or all zero.
    """

    def __init__(self, weights: Tensor, generator: torch.Generator) -> None:
        if not _are_usable(weights, weights.sum(dtype=torch.float64)):
            raise ValueError("weights must be finite, non-negative and not all zero: normalise")
        # Rows of weight zero are left out, so that rounding can never draw one.
        self._rows = torch.nonzero(weights).squeeze(1)
        self._cumulative = weights[self._rows].to(torch.float64).cumsum(0)
        self._generator = generator

    def draw(self, n: int) -> Tensor:
        """n row numbers, (n,) int64."""
        g = self._generator
        return self.at(torch.rand(n, dtype=torch.float64, generator=g, device=g.device))

    def at(self, u: Tensor) -> Tensor:
        """The row numbers (n,) for uniform draws on [0, 1), (n,) float64."""
        u = u.to(self._cumulative.device) * self._cumulative[-1]
        place = torch.searchsorted(self._cumulative, u, right=True)
        return self._rows[place.clamp_(max=len(self._rows) - 1)]


def uniform_indices(high: int, n: int, generator: torch.Generator) -> Tensor:
    """n uniform draws from 0..high-1 with replacement, (n,) int64."""
    return torch.randint(high, (n,), generator=generator, device=generator.device)


def block_size(device: torch.device, cpu: int, gpu: int) -> int:
    """Minibatches to gather at once: few fit a CPU's cache, many save launches on a GPU."""
    return cpu if device.type == "cpu" else gpu


def episode_numbers(rows: TensorTransitions) -> Tensor:
    """The episode number of each row (N,), int64, counted from 0."""
    ended = ((rows.terminated + rows.truncated) > 0).to(torch.int64)
    return ended.cumsum(0) - ended


def held_out_rows(rows: TensorTransitions, share: float, generator: torch.Generator) -> Tensor:
    """A mask (N,) of whole episodes, drawn at random, with at least `share` of the rows.

    At least one episode is not held out. With fewer than `FEW` episodes, blocks of `BLOCK`
    successive rows are used instead, or single rows if there would be few blocks as well.
    """
    groups = _groups(rows)
    length = torch.bincount(groups)
    order = torch.randperm(len(length), generator=generator, device=generator.device)
    order = order.to(length.device)
    before = length[order].cumsum(0) - length[order]
    chosen = order[before < share * len(rows)][: len(length) - 1]
    return torch.isin(groups, chosen)


def _groups(rows: TensorTransitions) -> Tensor:
    episodes = episode_numbers(rows)
    if int(episodes[-1]) + 1 >= FEW:
        return episodes
    block = BLOCK if len(rows) >= FEW * BLOCK else 1
    return torch.arange(len(rows), device=episodes.device) // block


def ess(weights: Tensor | np.ndarray) -> float:
    """Effective sample size as a share of the rows, (sum w)^2 / (N sum w^2), in (0, 1].

    Zero where every weight is zero.
    """
    w = torch.as_tensor(weights).to(torch.float64)
    squares = w.square().sum()
    return float(w.sum().square() / (squares * len(w))) if squares > 0 else 0.0


def zero_share(weights: Tensor | np.ndarray) -> float:
    """Share of the rows whose weight is zero; 0 without rows."""
    w = torch.as_tensor(weights)
    return float((w == 0).to(torch.float64).mean()) if len(w) else 0.0


def bin_means(weights: Tensor | np.ndarray, bins: int) -> Tensor:
    """Mean weight in each of `bins` equal parts, oldest to newest, (bins,) float64.

    A row across a border counts in both parts in proportion. So the mean of the bins is the mean
    weight for every N, and with fewer rows than bins a row spans several bins. Raises
    ValueError without rows.
    """
    w = torch.as_tensor(weights).to(torch.float64)
    n = len(w)
    if n == 0:
        raise ValueError("no weights to bin")
    border = torch.arange(bins + 1, device=w.device) * n  # in units of 1 / bins rows
    whole, part = border // bins, border % bins
    before = torch.cat((w.new_zeros(1), w.cumsum(0)))  # before[i]: sum of the first i weights
    up_to = before[whole] + torch.cat((w, w.new_zeros(1)))[whole] * part / bins
    return up_to.diff() * bins / n


def _are_usable(weights: Tensor, total: Tensor) -> bool:
    return bool(torch.isfinite(total) and total > 0 and (weights >= 0).all())
