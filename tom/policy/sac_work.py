"""SAC's actions and updates as work that members of a fleet can do together."""

from collections.abc import Hashable, Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import torch
from torch import Tensor

from tom.data.replay import ReplayBuffer
from tom.data.sampling import uniform_indices
from tom.nn.graphs import captured_step
from tom.nn.lockstep import Rank, Work
from tom.policy.sac import Sac


@dataclass
class Act(Work):
    """Work that draws an action for one observation (O,); then `action` (A,) is set, on the CPU."""

    rank: ClassVar[Rank] = Rank.ACT
    subject: Sac
    obs: Tensor
    generator: torch.Generator
    action: Tensor = field(init=False)

    @property
    def kind(self) -> Hashable:
        return self.subject.config, self.subject.dims

    @classmethod
    def do(cls, works: "Sequence[Act]", subject: Sac) -> None:
        obs = torch.stack([w.obs for w in works])[:, None].to(subject.device)
        actions = subject.act(obs, [w.generator for w in works])[:, 0].cpu()
        for work, action in zip(works, actions, strict=True):
            work.action = action


@dataclass
class SacUpdates(Work):
    """Work that takes a gradient step on each of G packed batches (G, B, R); sets `metrics`."""

    rank: ClassVar[Rank] = Rank.SAC
    subject: Sac
    batches: Tensor
    metrics: dict[str, Tensor] = field(init=False)

    @property
    def kind(self) -> Hashable:
        return self.subject.config, self.batches.shape

    @classmethod
    def do(cls, works: "Sequence[SacUpdates]", subject: Sac) -> None:
        batches = torch.stack([w.batches for w in works], 1)
        metrics = subject.updates(batches, captured_step(subject))
        for m, work in enumerate(works):
            work.metrics = {name: value[m : m + 1] for name, value in metrics.items()}


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
