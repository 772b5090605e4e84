"""The training of stacked networks: Adam in one fused call, an average, a network that goes on."""

from __future__ import annotations

from collections.abc import Sequence
from copy import deepcopy
from typing import Any

import torch
from torch import Tensor

from tom.nn.mlp import StackedMLP

BETAS = (0.9, 0.999)
EPS = 1e-8


class Adam:
    """Adam (Kingma & Ba 2015): first and second moments of parameters, and the update step.

    The arithmetic is exactly that of `torch.optim.Adam(fused=True)`, without its bookkeeping, which
    at these sizes takes longer than the arithmetic.

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
        decays = [weight_decay] * len(self.parameters) if one else list(weight_decay)
        lists = (self.parameters, self.means, self.squares, self.taken)
        # The parameters by weight decay, with the four lists of each fused call.
        self._groups: list[tuple[float, list[int], list[list[Tensor]]]] = []
        for decay in dict.fromkeys(decays):
            members = [i for i, own in enumerate(decays) if own == decay]
            self._groups.append((decay, members, [[x[i] for i in members] for x in lists]))

    @torch.no_grad()
    def step(self, gradients: Sequence[Tensor]) -> None:
        """Update every parameter in place."""
        # The fused kernel ignores a gradient's strides.
        gradients = [g.contiguous() for g in gradients]
        torch._foreach_add_(self.counters, 1)  # pyright: ignore[reportPrivateImportUsage]
        for decay, members, moved in self._groups:
            torch._fused_adam_(  # pyright: ignore[reportPrivateImportUsage]
                moved[0], [gradients[i] for i in members], moved[1], moved[2], [], moved[3],
                lr=self.lr, beta1=BETAS[0], beta2=BETAS[1], weight_decay=decay, eps=EPS,
                amsgrad=False, maximize=False,
            )  # fmt: skip

    def reset(self) -> None:
        """Forget all steps."""
        for tensor in (*self.counters, *self.means, *self.squares):
            tensor.zero_()

    def state_dict(self) -> dict[str, Any]:
        """As `torch.optim.Adam` has it, without the settings."""
        kept = zip(self.taken, self.means, self.squares, strict=True)
        names = ("step", "exp_avg", "exp_avg_sq")
        return {"state": {i: dict(zip(names, one, strict=True)) for i, one in enumerate(kept)}}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        """Copy the values of `state` in place, so that all who share the tensors see them."""
        for i, kept in state["state"].items():
            self.taken[i].copy_(kept["step"])
            self.means[i].copy_(kept["exp_avg"])
            self.squares[i].copy_(kept["exp_avg_sq"])


class Average:
    """An exponential average of `net`'s parameters over the steps of one fit.

    `Average.net` is the average, or `net` itself if decay is 0.

    The decay of step t = 0, 1, ... is at most t / (t + 10), so that the initial parameters are soon
    forgotten.
    """

    def __init__(self, net: StackedMLP, decay: float) -> None:
        self.decay = decay
        self.source = net
        self.net = deepcopy(net).requires_grad_(False) if decay else net
        self.steps = 0

    def update(self) -> None:
        """Include the current parameters in the average."""
        if self.decay:
            decay = min(self.decay, self.steps / (self.steps + 10))
            source = [p.detach() for p in self.source.parameters()]
            torch._foreach_lerp_(  # pyright: ignore[reportPrivateImportUsage]
                list(self.net.parameters()), source, 1 - decay
            )
            self.steps += 1


class Trained:
    """A network that is trained further from fit to fit, and its optimiser."""

    def __init__(self, net: StackedMLP, lr: float, weight_decay: float = 0.0) -> None:
        self.net = net
        self.optimiser = Adam(net.tensors(), lr, weight_decay)

    @property
    def device(self) -> torch.device:
        return self.net.layers[0][0].device

    def restart(self, net: StackedMLP) -> None:
        """Copy the parameters of `net` in place and reset the optimiser."""
        with torch.no_grad():
            for own, fresh in zip(self.net.tensors(), net.tensors(), strict=True):
                own.copy_(fresh)
        self.optimiser.reset()

    def state_dict(self) -> dict[str, Any]:
        return {"net": self.net.own_state(), "optimiser": self.optimiser.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.net.load_state_dict(state["net"])
        self.optimiser.load_state_dict(state["optimiser"])
