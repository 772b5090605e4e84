"""Stacked multi-layer perceptrons: M independent networks as one batched matrix product.

Twin critics, ensemble members and the seeds of a fleet are all members. A parameter's leading
axis is always the member axis M.
"""

from collections.abc import Callable, Sequence
from itertools import pairwise
from math import sqrt

import torch
from torch import Tensor, nn

from tom.rng import Generators

Activation = Callable[[Tensor], Tensor]


class StackedMLP(nn.Module):
    """M independent MLPs with sizes (in, hidden, ..., out): (M, B, in) -> (M, B, out).

    Weights start as in `torch.nn.Linear`, uniform in +-1/sqrt(in). `generators` is one generator
    for each seed; where there are more members than generators (twin critics, ensembles), each
    fills an equal run of consecutive members.
    """

    def __init__(
        self,
        members: int,
        sizes: Sequence[int],
        activation: Activation,
        generators: Generators,
    ) -> None:
        super().__init__()
        if members % len(generators):
            raise ValueError(f"{members} members cannot be shared by {len(generators)} generators")
        self.members = members
        self.activation = activation
        self.weights = nn.ParameterList()  # (M, in, out) each
        self.biases = nn.ParameterList()  # (M, 1, out) each
        per_generator = members // len(generators)
        for n_in, n_out in pairwise(sizes):
            bound = 1.0 / sqrt(n_in)
            rows = [
                (torch.rand(per_generator, n_in + 1, n_out, generator=g) * 2 - 1) * bound
                for g in generators
            ]
            drawn = torch.cat(rows)  # (M, in + 1, out); the last row is the bias
            self.weights.append(nn.Parameter(drawn[:, :-1].contiguous()))
            self.biases.append(nn.Parameter(drawn[:, -1:].contiguous()))

    def forward(self, x: Tensor) -> Tensor:
        return self._run(x, list(self.weights), list(self.biases))

    def member(self, index: int, x: Tensor) -> Tensor:
        """Network `index` alone: (B, in) -> (B, out)."""
        weights = [w[index : index + 1] for w in self.weights]
        biases = [b[index : index + 1] for b in self.biases]
        return self._run(x.unsqueeze(0), weights, biases).squeeze(0)

    def _run(self, x: Tensor, weights: list[Tensor], biases: list[Tensor]) -> Tensor:
        last = len(weights) - 1
        for layer, (weight, bias) in enumerate(zip(weights, biases, strict=True)):
            x = torch.baddbmm(bias, x, weight)
            if layer < last:
                x = self.activation(x)
        return x
