"""A network that is trained further from fit to fit."""

from __future__ import annotations

from typing import Any

import torch

from tom.nn.adam import Adam
from tom.nn.mlp import StackedMLP


class Trained:
    """A network and its optimiser."""

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
        for tensor in self.optimiser.tensors():
            tensor.zero_()

    def state_dict(self) -> dict[str, Any]:
        return {"net": self.net.own_state(), "optimiser": self.optimiser.state_dict()}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        self.net.load_state_dict(state["net"])
        self.optimiser.load_state_dict(state["optimiser"])
