"""The energy distance: how far two samples lie apart, over all their dimensions at once.

E = 2 E|x - y| - E|x - x'| - E|y - y'| is zero where both have one distribution, and positive
elsewhere (Szekely and Rizzo 2013). Here it says how far a weighted buffer lies from what a policy
does: its footprint.
"""

from math import isfinite

import torch
from torch import Tensor

from tom.data.sampling import WeightedSampler
from tom.data.scaling import Scaling
from tom.data.transitions import TensorTransitions

DRAWS = 2000
"""draws that stand for a buffer, and the rows of a footprint that are compared at most"""
MOMENTS = 20_000
"""rows of a buffer that its moments are taken of at most"""


def energy_distance(x: Tensor, y: Tensor, rows: Tensor | None = None) -> float:
    """E of samples x (N, D) and y (M, D) by U-statistics: no pair of a row with itself.

    So it is unbiased, and may be below zero. Where x are draws of a table that may hold a row more
    than once, `rows` (N,) says of which row each is. NaN where a sample has no two rows.
    """
    x, y = x.double(), y.double()  # distances are found by products, which lose half the digits
    return float(2 * torch.cdist(x, y).mean() - _within(x, rows) - _within(y))


def _within(x: Tensor, rows: Tensor | None = None) -> Tensor:
    """E|x - x'| over pairs of different rows."""
    same = len(x) if rows is None else rows.unique(return_counts=True)[1].square().sum()
    return torch.cdist(x, x).sum() / (len(x) ** 2 - same)


def step_scaling(buffer: TensorTransitions) -> Scaling:
    """The scaling of z = (s, a, s' - s), 2 O + A columns, by `MOMENTS` rows of a buffer at most."""
    rows = _thinned(buffer, MOMENTS)
    return Scaling.of((rows.obs, rows.action), (rows.next_obs, rows.obs))


def footprint_match(
    buffer: TensorTransitions,
    weights: Tensor,
    footprint: TensorTransitions,
    scaling: Scaling,
    generator: torch.Generator,
) -> dict[str, float]:
    """How far a buffer weighted by (N,) lies from a policy's footprint, over z (`step_scaling`).

    `footprint_uniform` is E between the buffer without weights and the footprint, `footprint` that
    of the weighted buffer and `footprint_noise` that of two halves of the footprint, both over
    `footprint_uniform`: 1 is no better than no weights, 0 like the policy itself, and differences
    of the size of the noise say nothing. What cannot be measured is left out: all with fewer than
    two rows, and the two ratios where `footprint_uniform` is not above zero.
    """
    met = _thinned(footprint, DRAWS)
    z = _steps(met, scaling)
    u = torch.rand(DRAWS, dtype=torch.float64, generator=generator, device=generator.device)

    def distance(by: Tensor) -> float:
        """Both by the same random numbers: equal weights are equal to the last bit."""
        rows = WeightedSampler(by, generator).at(u)
        return energy_distance(_steps(buffer[rows], scaling), z, rows)

    uniform = distance(torch.ones_like(weights))
    found = {"footprint_uniform": uniform}
    if uniform > 0:
        found["footprint"] = distance(weights) / uniform
        first = first_half(met)
        found["footprint_noise"] = energy_distance(z[first], z[~first]) / uniform
    return {name: value for name, value in found.items() if isfinite(value)}


def first_half(rows: TensorTransitions) -> Tensor:
    """Which rows (N,) are of the first of two halves: whole episodes where there are several.

    The longest episode goes into the first half and each next one into the smaller, so that they
    are about even. A single episode is parted in the middle.
    """
    ended = ((rows.terminated + rows.truncated) > 0).long()
    lengths = (ended.cumsum(0) - ended).unique(return_counts=True)[1].tolist()
    if len(lengths) < 2:
        return torch.arange(len(rows), device=rows.obs.device) < len(rows) // 2
    first, sizes = [False] * len(lengths), [0, 0]
    for episode in sorted(range(len(lengths)), key=lambda k: -lengths[k]):
        first[episode] = sizes[0] <= sizes[1]
        sizes[not first[episode]] += lengths[episode]
    of = torch.tensor(lengths, device=ended.device)
    return torch.tensor(first, device=ended.device).repeat_interleave(of)


def _steps(rows: TensorTransitions, scaling: Scaling) -> Tensor:
    """z-scored (s, a, s' - s), (N, 2 O + A)."""
    return scaling(torch.cat((rows.obs, rows.action, rows.next_obs - rows.obs), 1))


def _thinned(rows: TensorTransitions, most: int) -> TensorTransitions:
    """Every k-th row, so that there are `most` at most."""
    return rows[:: max(-(-len(rows) // most), 1)]
