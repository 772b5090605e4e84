"""Split rows in order of collection into episodes."""

import torch
from torch import Tensor

from tom.data.transitions import TensorTransitions

FEW = 10  # with fewer episodes than this, blocks of rows are held out instead
BLOCK = 100  # rows


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
