"""A batch of transitions (s, a, r, s'), the data type that the whole backend shares."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Self

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:  # torch takes a second to import, and a reader of runs does without it
    from torch import Tensor

BEHAVIOUR = ("behaviour_mean", "behaviour_log_std")
"""the arrays, (N, A) each, of the Gaussian before tanh that each row's action was drawn from"""


@dataclass(frozen=True)
class Transitions:
    """N transitions. Every field has a leading N and is a numpy array or a tensor.

    `terminated` ends the value (no bootstrap); `truncated` (a time limit) does not.
    """

    obs: Tensor | np.ndarray  # (N, O)
    action: Tensor | np.ndarray  # (N, A)
    reward: Tensor | np.ndarray  # (N,)
    next_obs: Tensor | np.ndarray  # (N, O)
    terminated: Tensor | np.ndarray  # (N,)
    truncated: Tensor | np.ndarray  # (N,)

    def __len__(self) -> int:
        return len(self.obs)

    def __getitem__(self, index: slice | Tensor | np.ndarray | None) -> Self:
        return type(self)(*(getattr(self, f.name)[index] for f in fields(self)))

    def torch(self) -> TensorTransitions:
        """The same rows as float32 tensors; shares memory where it can."""
        import torch

        return TensorTransitions(
            *(torch.as_tensor(getattr(self, f.name)).to(torch.float32) for f in fields(self))
        )

    def numpy(self) -> Transitions:
        """The same rows as numpy arrays; shares memory where it can."""
        parts = (getattr(self, f.name) for f in fields(self))
        return Transitions(*(np.asarray(p.cpu() if hasattr(p, "cpu") else p) for p in parts))

    def ended(self) -> np.ndarray:
        """Which rows are the last of their episode, terminated or truncated: (N,) bool."""
        t = self.numpy()
        return (np.asarray(t.terminated) != 0) | (np.asarray(t.truncated) != 0)

    @staticmethod
    def concatenate(parts: Sequence[Transitions]) -> Transitions:
        """The rows of all parts, in order, as numpy arrays."""
        arrays = [p.numpy() for p in parts]
        return Transitions(
            *(np.concatenate([getattr(a, f.name) for a in arrays]) for f in fields(Transitions))
        )


@dataclass(frozen=True)
class TensorTransitions(Transitions):
    """Transitions that are float32 tensors throughout (flags are 0 or 1)."""

    obs: Tensor
    action: Tensor
    reward: Tensor
    next_obs: Tensor
    terminated: Tensor
    truncated: Tensor

    def moves(self) -> Tensor:
        """(s, a, s' - s) of every row, (N, 2 O + A)."""
        import torch

        return torch.cat((self.obs, self.action, self.next_obs - self.obs), 1)

    def copy(self) -> TensorTransitions:
        """A copy of the rows (a buffer's rows are views that may change)."""
        return TensorTransitions(*(getattr(self, f.name).clone() for f in fields(self)))

    def packed(self) -> Tensor:
        """The same rows as one tensor (..., R), R = 2 O + A + 3; `unpack` is the inverse."""
        import torch

        flags = torch.stack((self.terminated, self.truncated), -1)
        return torch.cat((self.obs, self.action, self.reward[..., None], self.next_obs, flags), -1)

    @staticmethod
    def unpack(rows: Tensor, obs_dim: int, action_dim: int) -> TensorTransitions:
        """Packed rows (..., R) as transitions that are views of them."""
        sizes = (obs_dim, action_dim, 1, obs_dim, 1, 1)
        obs, action, reward, next_obs, terminated, truncated = rows.split(sizes, -1)
        flags = terminated.squeeze(-1), truncated.squeeze(-1)
        return TensorTransitions(obs, action, reward.squeeze(-1), next_obs, *flags)

    @staticmethod
    def join(parts: Sequence[TensorTransitions]) -> TensorTransitions:
        """The rows of all parts, in order, as tensors."""
        import torch

        return TensorTransitions(
            *(torch.cat([getattr(p, f.name) for p in parts]) for f in fields(TensorTransitions))
        )


def episodes(rows: Transitions) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.float64]]:
    """For each row (N,): the number of its episode, its place in it, and the episode's return."""
    ended = rows.ended()
    number = np.concatenate([[0], np.cumsum(ended)[:-1]]).astype(np.int64)[: len(rows)]
    starts = np.searchsorted(number, np.arange(number[-1] + 1)) if len(number) else number
    totals = np.bincount(number, np.asarray(rows.reward, np.float64)).astype(np.float64)
    return number, np.arange(len(rows)) - starts[number], totals[number]
