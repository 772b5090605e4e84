"""What a training asks of its SAC, as work that members of a fleet do in one go."""

from collections.abc import Hashable, Sequence
from dataclasses import dataclass, field
from typing import ClassVar

import torch
from torch import Tensor

from tom.nn.lockstep import Work
from tom.policy.sac import Sac


@dataclass
class Act(Work):
    """Work: an action drawn for one observation (O,); then `action` (A,) is there, on the CPU."""

    rank: ClassVar[int] = 0
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
    """Work: a gradient step on each of G packed batches (G, B, R); then `metrics`, (1,) each."""

    rank: ClassVar[int] = 5
    subject: Sac
    batches: Tensor
    metrics: dict[str, Tensor] = field(init=False)

    @property
    def kind(self) -> Hashable:
        return self.subject.config, self.batches.shape

    @classmethod
    def do(cls, works: "Sequence[SacUpdates]", subject: Sac) -> None:
        found = subject.updates(torch.stack([w.batches for w in works], 1))
        for m, work in enumerate(works):
            work.metrics = {name: value[m : m + 1] for name, value in found.items()}
