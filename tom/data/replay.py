"""A first-in-first-out buffer of transitions: the replay, the policy and the model buffer."""

from typing import Any

import numpy as np
import torch
from torch import Tensor

from tom.data.transitions import TensorTransitions


class ReplayBuffer:
    """The last `capacity` transitions added, oldest first.

    A transition is one row of a packed float32 tensor (capacity, 2 O + A + 3), so that a minibatch
    is one `index_select`; beside it stands the version of the policy that collected it. Memory is
    reserved at once but touched row by row. Batches handed out without a copy are views of the
    live rows: they change when the buffer, once full, writes over them.
    """

    def __init__(
        self, capacity: int, obs_dim: int, action_dim: int, device: torch.device | str = "cpu"
    ) -> None:
        if capacity < 1:
            raise ValueError(f"capacity must be at least 1, not {capacity}")
        self.capacity = capacity
        self.total_added = 0
        self._dims = (obs_dim, action_dim)
        self._rows = torch.empty(capacity, 2 * obs_dim + action_dim + 3, device=device)
        self._versions = torch.empty(capacity, dtype=torch.int64, device=device)
        self._size = 0
        self._end = 0  # where the next row goes

    def __len__(self) -> int:
        return self._size

    def add(
        self,
        obs: np.ndarray,
        action: np.ndarray,
        reward: float,
        next_obs: np.ndarray,
        terminated: bool,
        truncated: bool,
        policy_version: int = 0,
    ) -> None:
        """Append one transition: obs and next_obs (O,), action (A,)."""
        row = np.concatenate((obs, action, (reward,), next_obs, (terminated, truncated)))
        self._rows[self._end] = torch.from_numpy(row.astype(np.float32))
        # Filled, not assigned: a number that is assigned on a GPU becomes a tensor first.
        self._versions[self._end].fill_(policy_version)
