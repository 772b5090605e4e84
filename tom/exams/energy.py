"""The energy distance between two samples, over all their dimensions at once.

E = 2 E|x - y| - E|x - x'| - E|y - y'| is zero if both have the same distribution, else positive
(Szekely and Rizzo 2013). Here it measures the distance of a weighted buffer from a policy's
footprint.
"""

from math import isfinite

import torch
from torch import Tensor

from tom.data.sampling import WeightedSampler, episode_numbers
from tom.data.scaling import Scaling
from tom.data.transitions import TensorTransitions

DRAWS = 2000
"""draws from a buffer, and maximum rows of a footprint, that are compared"""
GROUPS, FEWEST = 10, 5
"""most and fewest groups of whole episodes for the jackknife: steps within one are correlated"""
MOMENTS = 20_000
"""maximum rows of a buffer from which its moments are computed"""


def energy_distance(x: Tensor, y: Tensor) -> float:
    """E of samples x (N, D) and y (M, D) by U-statistics, without pairs of a row with itself.

    So it is unbiased and may be negative. NaN if a sample has fewer than two rows.
    """
    x, y = x.double(), y.double()  # distances from products lose half the digits
    cross = torch.cdist(x, y).mean()
    within = [torch.cdist(z, z).sum() / (len(z) * (len(z) - 1)) for z in (x, y) if len(z) > 1]
    return float(2 * cross - sum(within)) if len(within) == 2 else float("nan")


def drawn_distance(x: Tensor, rows: Tensor) -> Tensor:
    """E|x - x'| over pairs of different rows of a weighted table, from draws x (N, D) of `rows`.

    The weight has N / 2 equal parts, and draws 2 k and 2 k + 1 come from the k-th. Two independent
    draws would meet in one part as often as in any two, so every pair of parts must count alike:
    two different parts have four ordered pairs of draws, one part with itself only two, which
    count twice. Pairs of the same row are left out. Not finite if all draws are the same row.
    """
    first, second = slice(0, None, 2), slice(1, None, 2)
    within = (x[first] - x[second]).norm(dim=1).sum()
    total = torch.cdist(x, x).sum() + 2 * within
    drawn = rows.unique(return_counts=True)[1]
    same = drawn.square().sum() - len(x) + 2 * (rows[first] == rows[second]).sum()
    return total / (len(x) ** 2 - same)


def step_scaling(buffer: TensorTransitions) -> Scaling:
    """The scaling of z = (s, a, s' - s), 2 O + A columns, from `MOMENTS` rows at most."""
    return Scaling.of_moves(buffer[_stride(len(buffer), MOMENTS)])


def footprint_match(
    buffer: TensorTransitions,
    weights: Tensor,
    footprint: TensorTransitions,
    scaling: Scaling,
    generator: torch.Generator,
) -> dict[str, float]:
    """The distance of a buffer with weights (N,) from a footprint, over z (`step_scaling`).

    `footprint_uniform` is E between the unweighted buffer and the footprint (rows in order). The
    others are divided by it: `footprint`, E of the weighted buffer (1: no better than no weights,
    0: like the policy itself); `footprint_se`, its standard error over the policy's episodes, the
    buffer given, by a jackknife over groups of these (`_selections`); `footprint_noise`, E between
    two halves of the footprint (`first_half`). Values that cannot be measured are left out: with
    too few rows or episodes, and ratios if `footprint_uniform` is not positive.
    """
    every = _stride(len(footprint), DRAWS)
    # Episodes and halves are those of all rows: few of the thinned ones end an episode.
    episodes, first = (of(footprint)[every] for of in (episode_numbers, first_half))
    z = scaling(footprint[every].moves()).double()
    u = torch.rand(DRAWS, dtype=torch.float64, generator=generator, device=generator.device)
    u = (torch.arange(DRAWS, device=u.device) // 2 + u) / (DRAWS // 2)  # `drawn_distance`
    apart, kept = torch.cdist(z, z), _selections(episodes)

    def distances(by: Tensor) -> Tensor:
        """Both use the same random numbers, so that equal weights give exactly equal distances."""
        rows = WeightedSampler(by, generator).at(u)
        x = scaling(buffer[rows].moves()).double()
        count = kept.sum(0)
        within = (kept * (apart @ kept)).sum(0) / (count * (count - 1))
        cross = torch.cdist(x, z).mean(0) @ kept / count
        return 2 * cross - drawn_distance(x, rows) - within

    uniform = distances(torch.ones_like(weights))
    metrics = {"footprint_uniform": float(uniform[0])}
    if uniform[0] > 0:
        ratio = distances(weights) / uniform
        metrics["footprint"] = float(ratio[0])
        if len(ratio) > 1:
            spread = ratio[1:].var(correction=0) * (len(ratio) - 2)
            metrics["footprint_se"] = float(spread.sqrt())
        metrics["footprint_noise"] = energy_distance(z[first], z[~first]) / float(uniform[0])
    return {name: value for name, value in metrics.items() if isfinite(value)}


def _selections(episodes: Tensor) -> Tensor:
    """Masks (N, 1 + G) of 0 and 1: all rows, then all except one of G groups in turn.

    A group is the neighbouring episodes whose middles lie in the same of `GROUPS` equal stretches
    of the N rows, of which `episodes` (N,) has the numbers. With fewer than `FEWEST` groups there
    is only the first mask.
    """
    n, device = len(episodes), episodes.device
    every = torch.ones(n, 1, dtype=torch.float64, device=device)
    length = episodes.unique_consecutive(return_counts=True)[1]
    stretch = (2 * length.cumsum(0) - length) * GROUPS // (2 * n)
    groups = stretch.unique()
    if len(groups) < FEWEST:
        return every
    without = stretch.repeat_interleave(length)[:, None] != groups
    return torch.cat((every, without.double()), 1)


def first_half(rows: TensorTransitions) -> Tensor:
    """A mask (N,) of the first of two halves, made of whole episodes if there are several.

    The longest episode goes into the first half and each next one into the smaller half, so that
    they are about equal. A single episode is split in the middle.
    """
    lengths = torch.bincount(episode_numbers(rows)).tolist()
    if len(lengths) < 2:
        return torch.arange(len(rows), device=rows.obs.device) < len(rows) // 2
    first, sizes = [False] * len(lengths), [0, 0]
    for episode in sorted(range(len(lengths)), key=lambda k: -lengths[k]):
        first[episode] = sizes[0] <= sizes[1]
        sizes[not first[episode]] += lengths[episode]
    device = rows.obs.device
    return torch.tensor(first, device=device).repeat_interleave(
        torch.tensor(lengths, device=device)
    )


def _stride(n: int, most: int) -> slice:
    """Every k-th of n rows, so that at most `most` remain."""
    return slice(None, None, max(-(-n // most), 1))
