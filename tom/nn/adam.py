"""Adam (Kingma & Ba 2015) over the tensors of stacked networks, in one fused call.

The arithmetic is that of `torch.optim.Adam(fused=True)`, to the last bit; what is left out is the
bookkeeping around it, which at these sizes takes longer than the arithmetic.
"""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

BETAS = (0.9, 0.999)
EPS = 1e-8


class Adam:
    """First and second moments of parameters, and the step that they ask for.

    `weight_decay` is one L2 coefficient for all parameters, or one for each.
    """

    def __init__(
        self,
        parameters: Sequence[Tensor],
        lr: float,
        weight_decay: float | Sequence[float] = 0.0,
    ) -> None:
        self.lr = lr
        self.parameters = list(parameters)
        self.means = [torch.zeros_like(p, requires_grad=False) for p in self.parameters]
        self.squares = [torch.zeros_like(p, requires_grad=False) for p in self.parameters]
        self.counters = [torch.zeros((), device=p.device) for p in self.parameters[:1]]
        self.taken = self.counters * len(self.parameters)  # steps so far: one counter for all
        one = isinstance(weight_decay, int | float)
        self.decays = [weight_decay] * len(self.parameters) if one else list(weight_decay)
        self.members = 1
        self._group()

    @torch.no_grad()
    def step(self, gradients: Sequence[Tensor]) -> None:
        """Move every parameter in place by its gradient.

        A joined one takes the gradients of the joined networks, members stacked in front.
        """
        if self.members > 1:
            parts = [g.chunk(self.members) for g in gradients]
            gradients = [g for member in zip(*parts, strict=True) for g in member]
        # The fused kernel reads memory in order, whatever a gradient's strides are.
        gradients = [g.contiguous() for g in gradients]
        torch._foreach_add_(self.counters, 1)  # pyright: ignore[reportPrivateImportUsage]
        for decay, members, moved in self._groups:
            torch._fused_adam_(  # pyright: ignore[reportPrivateImportUsage]
                moved[0], [gradients[i] for i in members], moved[1], moved[2], [], moved[3],
                lr=self.lr, beta1=BETAS[0], beta2=BETAS[1], weight_decay=decay, eps=EPS,
                amsgrad=False, maximize=False,
            )  # fmt: skip

    @staticmethod
    def joined(optimisers: "Sequence[Adam]") -> "Adam":
        """One Adam over the parameters of all: the same tensors, so that each goes on being itself.

        Each may have taken another number of steps.
        """
        joint = Adam([], optimisers[0].lr)
        joint.members = len(optimisers)
        for name in ("parameters", "means", "squares", "counters", "taken", "decays"):
            setattr(joint, name, [x for one in optimisers for x in getattr(one, name)])
        joint._group()
        return joint

    def tensors(self) -> list[Tensor]:
        """All that a step changes, but for the parameters."""
        return [*self.counters, *self.means, *self.squares]

    def state_dict(self) -> dict[str, Any]:
        """As `torch.optim.Adam` has it, without the settings."""
        kept = zip(self.taken, self.means, self.squares, strict=True)
        names = ("step", "exp_avg", "exp_avg_sq")
        return {"state": {i: dict(zip(names, one, strict=True)) for i, one in enumerate(kept)}}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Take the values of `state` in place: whoever shares this state sees them."""
        for i, kept in state["state"].items():
            self.taken[i].copy_(kept["step"])
            self.means[i].copy_(kept["exp_avg"])
            self.squares[i].copy_(kept["exp_avg_sq"])

    def _group(self) -> None:
        """A call for each weight decay: which parameters, and their four lists."""
        lists = (self.parameters, self.means, self.squares, self.taken)
        self._groups: list[tuple[float, list[int], list[list[Tensor]]]] = []
        for decay in dict.fromkeys(self.decays):
            members = [i for i, own in enumerate(self.decays) if own == decay]
            self._groups.append((decay, members, [[x[i] for i in members] for x in lists]))
