"""Prioritised replay of Ray's RLlib, as weights for `run.weights` (docs/your-own-loop.md)."""

from typing import Any

import numpy as np
from numpy.typing import NDArray


def priorities(buffer: Any) -> NDArray[np.float64]:
    """The shares (N,) by which a `PrioritizedReplayBuffer` of single steps draws, oldest first.

    That is priority ** alpha. The library changes a priority when a row is drawn.
    """
    held = np.array([buffer._it_sum[row] for row in range(len(buffer))], np.float64)
    return np.roll(held, -buffer._next_idx) if len(buffer) == buffer.capacity else held
