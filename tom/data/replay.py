"""A first-in-first-out buffer of transitions: the replay, the policy and the model buffer."""

from collections.abc import Mapping
from math import nan
from typing import Any

import numpy as np
import torch
from torch import Tensor

from tom.data.transitions import TensorTransitions


class ReplayBuffer:
    """The last `capacity` transitions added, oldest first.

    A transition is one row of a packed float32 tensor (capacity, 2 O + A + 3), so that a minibatch
    is one `index_select`. Two more tensors say who collected each row: the version of the policy,
    and with `keeps_behaviour` the Gaussian that its action was drawn from (`behaviour`). Memory is
    reserved at once but touched row by row. Batches returned without a copy are views of the live
    rows: they change when the full buffer overwrites them.
    """

    def __init__(
        self,
        capacity: int,
        obs_dim: int,
        action_dim: int,
        device: torch.device | str = "cpu",
        *,
        keeps_behaviour: bool = False,
    ) -> None:
        self.capacity = capacity
        self.total_added = 0
        self._dims = (obs_dim, action_dim)
        width = 2 * action_dim if keeps_behaviour else 0
        self._held = {
            "rows": torch.empty(capacity, 2 * obs_dim + action_dim + 3, device=device),
            "policy_version": torch.empty(capacity, dtype=torch.int64, device=device),
            "behaviour": torch.empty(capacity, width, device=device),
        }
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
        behaviour: np.ndarray | None = None,
    ) -> None:
        """Append one transition: obs and next_obs (O,), action (A,), behaviour (2 A,)."""
        row = np.concatenate((obs, action, (reward,), next_obs, (terminated, truncated)))
        self._held["rows"][self._end] = torch.from_numpy(row.astype(np.float32))
        # `fill_` because assigning a number on a GPU would first make a tensor of it.
        self._held["policy_version"][self._end].fill_(policy_version)
        if behaviour is None:
            self._held["behaviour"][self._end].fill_(nan)
        else:
            self._held["behaviour"][self._end] = torch.from_numpy(behaviour)
        self._advance(1)

    def extend(
        self,
        rows: TensorTransitions,
        policy_version: Tensor | int = 0,
        behaviour: Tensor | None = None,
    ) -> None:
        """Append N transitions in order; `policy_version` is (N,) or one for all."""
        if not len(rows):
            return  # a run folder without rows does not know their width
        if isinstance(policy_version, int):  # created on the buffer's device, not copied to it
            policy_version = self._held["policy_version"].new_full((len(rows),), policy_version)
        given = {"policy_version": policy_version, "behaviour": behaviour}
        self.restore_tail({"rows": rows.packed(), **given})

    def transitions(self) -> TensorTransitions:
        """Everything, oldest first; views while the buffer has not wrapped, a copy afterwards."""
        return self._unpack(self._ordered("rows"))

    def policy_version(self) -> Tensor:
        """The policy version of every row, oldest first, (N,) int64."""
        return self._ordered("policy_version")

    def behaviour(self) -> Tensor:
        """The Gaussian before tanh that each row's action was drawn from, oldest first, (N, 2 A).

        Means, then log standard deviations. NaN where there was none (exploration), or it is not
        known.
        """
        return self._ordered("behaviour")

    def gather(self, index: Tensor) -> TensorTransitions:
        """The rows at `index` (n,), counted from the oldest."""
        return self._unpack(self.packed(index))

    def packed(self, index: Tensor) -> Tensor:
        """The same rows as they are stored, (n, R)."""
        return self._held["rows"].index_select(0, self._physical(index))

    def last(self, n: int) -> TensorTransitions:
        """The newest n rows (or all, if there are fewer), oldest first."""
        n, rows = min(n, self._size), self._held["rows"]
        if n <= self._end:
            return self._unpack(rows[self._end - n : self._end])
        return self.gather(torch.arange(self._size - n, self._size, device=rows.device))

    def since(self, total: int) -> TensorTransitions:
        """The rows added after the first `total` ever added, as far as they are still held.

        Their policy versions and behaviour are the last entries of those.
        """
        return self.last(max(self.total_added - total, 0))

    def tail(self, n: int) -> dict[str, Tensor]:
        """The newest n rows (or all, if there are fewer), for `restore_tail`."""
        first, device = max(self._size - n, 0), self._held["rows"].device
        newest = self._physical(torch.arange(first, self._size, device=device))
        return {name: stored.index_select(0, newest) for name, stored in self._held.items()}

    def restore_tail(self, tail: Mapping[str, Any]) -> None:
        """Append rows as `tail` has them; a behaviour of None is not known."""
        count = len(tail["rows"])
        first = max(count - self.capacity, 0)
        self.total_added += first
        head = min(count, first + self.capacity - self._end)
        for part in (slice(first, head), slice(head, count)):
            n = part.stop - part.start
            for name, stored in self._held.items():
                values = tail[name]
                stored[self._end : self._end + n] = nan if values is None else values[part]
            self._advance(n)

    def clear(self) -> None:
        """Forget every row; `total_added` goes on counting."""
        self._size = self._end = 0

    def resize(self, capacity: int) -> None:
        """Change the capacity; the newest rows stay."""
        if capacity == self.capacity:
            return
        kept = self.tail(min(self._size, capacity))
        total = self.total_added
        self.capacity = capacity
        self._held = {n: old.new_empty(capacity, *old.shape[1:]) for n, old in self._held.items()}
        self.clear()
        self.restore_tail(kept)
        self.total_added = total

    def state_dict(self) -> dict[str, Any]:
        """Tensors and integers only: the held rows, oldest first."""
        return {**self.tail(self._size), "total_added": self.total_added}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.clear()
        self.restore_tail(state)
        self.total_added = state["total_added"]

    def _advance(self, n: int) -> None:
        self._end = (self._end + n) % self.capacity
        self._size = min(self._size + n, self.capacity)
        self.total_added += n

    def _ordered(self, name: str) -> Tensor:
        stored = self._held[name]
        if self._size == self.capacity and self._end:
            return torch.cat((stored[self._end :], stored[: self._end]))
        return stored[: self._size]

    def _physical(self, index: Tensor) -> Tensor:
        if self._size < self.capacity:
            return index
        return (index + self._end) % self.capacity

    def _unpack(self, rows: Tensor) -> TensorTransitions:
        return TensorTransitions.unpack(rows, *self._dims)
