"""The minibatches of SAC: a share of real transitions, the rest modelled."""

import torch
from torch import Tensor

from tom.data.replay import ReplayBuffer
from tom.data.sampling import uniform_indices


def mixed_batches(
    real: ReplayBuffer,
    modelled: ReplayBuffer,
    updates: int,
    size: int,
    real_ratio: float,
    generator: torch.Generator,
) -> Tensor:
    """Packed minibatches (G, B, R), drawn uniformly: a share of real rows, then modelled ones."""
    n = int(real_ratio * size)
    real_rows = uniform_indices(len(real), updates * n, generator)
    modelled_rows = uniform_indices(len(modelled), updates * (size - n), generator)
    real_part = real.packed(real_rows).unflatten(0, (updates, n))
    modelled_part = modelled.packed(modelled_rows).unflatten(0, (updates, size - n))
    return torch.cat([real_part, modelled_part], 1)
