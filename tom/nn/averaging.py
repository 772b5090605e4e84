"""An exponential average of a network's parameters over the steps of one fit."""

from copy import deepcopy

import torch

from tom.nn.mlp import StackedMLP


class Average:
    """Follows `net`; `Average.net` holds the average, or `net` itself where decay is 0.

    The early steps count less: the t-th step's decay is at most t / (t + 10), so that no trace of
    the first parameters stays.
    """

    def __init__(self, net: StackedMLP, decay: float) -> None:
        self.decay = decay
        self.source = net
        self.net = deepcopy(net).requires_grad_(False) if decay else net
        self.steps = 0

    def update(self) -> None:
        """Take in the parameters as they stand."""
        if self.decay:
            decay = min(self.decay, self.steps / (self.steps + 10))
            source = [p.detach() for p in self.source.parameters()]
            torch._foreach_lerp_(  # pyright: ignore[reportPrivateImportUsage]
                list(self.net.parameters()), source, 1 - decay
            )
            self.steps += 1
