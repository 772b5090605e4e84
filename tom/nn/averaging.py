"""An exponential average of a network's parameters over the steps of one fit."""

from copy import deepcopy

import torch

from tom.nn.mlp import StackedMLP


class Average:
    """Averages `net`'s parameters; `Average.net` is the average, or `net` itself if decay is 0.

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
