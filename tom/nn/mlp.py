"""Stacked multi-layer perceptrons: M independent networks evaluated by batched matrix products.

Twin critics and the networks of an ensemble are members. A parameter's leading axis is always the
member axis M.

Backpropagation through ReLU networks is written out for SAC, whose updates are small matrix
products and much bookkeeping (docs/speed.md). All else is differentiated by autograd.
"""

from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise
from math import sqrt

import torch
from torch import Tensor, nn
from torch.nn.functional import relu, silu

from tom.machine import matmul

BULK = 256  # number of rows from which passes over memory dominate
GPU_ROWS = 20_000
"""minimum number of rows evaluated at once on a GPU, where launches dominate"""

Activation = Callable[[Tensor], Tensor]

_IN_PLACE: dict[Activation, Activation] = {
    relu: torch.relu_,
    silu: partial(silu, inplace=True),
    torch.tanh: torch.tanh_,
}
"""the same in place, for use without gradients"""


class StackedMLP(nn.Module):
    """M independent MLPs with sizes (in, hidden, ..., out): (M, B, in) -> (M, B, out).

    Weights start as in `torch.nn.Linear`, uniform in +-1/sqrt(in).
    """

    def __init__(
        self,
        members: int,
        sizes: Sequence[int],
        activation: Activation,
        generator: torch.Generator,
    ) -> None:
        super().__init__()
        layers = []
        for n_in, n_out in pairwise(sizes):
            bound = 1.0 / sqrt(n_in)
            shape = (members, n_in + 1, n_out)  # the last row is the bias
            uniform = torch.rand(shape, generator=generator, device=generator.device)
            drawn = (uniform * 2 - 1) * bound
            layers.append((drawn[:, :-1].contiguous(), drawn[:, -1:].contiguous()))
        self.activation = activation
        self.weights = nn.ParameterList(w for w, _ in layers)  # (M, in, out) each
        self.biases = nn.ParameterList(b for _, b in layers)  # (M, 1, out) each
        # The same tensors in a plain tuple, because access to a ParameterList is slow.
        self.layers = tuple(zip(self.weights, self.biases, strict=True))

    def tensors(self) -> list[Tensor]:
        """The parameters: every layer's weight, then every layer's bias."""
        return [*(weight for weight, _ in self.layers), *(bias for _, bias in self.layers)]

    def own_state(self) -> dict[str, Tensor]:
        """A copy of `state_dict`."""
        return {name: value.clone() for name, value in self.state_dict().items()}

    def forward(self, x: Tensor) -> Tensor:
        return self._run(x, self.layers)

    def member(self, index: int, x: Tensor) -> Tensor:
        """Network `index` alone: (B, in) -> (B, out)."""
        return self._member(index, x, self.layers)

    @torch.no_grad()
    def hidden(self, index: int, x: Tensor) -> Tensor:
        """The last hidden layer of network `index`: (B, in) -> (B, H)."""
        return self.activation(self._member(index, x, self.layers[:-1]))

    def _member(self, index: int, x: Tensor, layers: Sequence[tuple[Tensor, Tensor]]) -> Tensor:
        only = slice(index, index + 1)
        return self._run(x.unsqueeze(0), [(w[only], b[only]) for w, b in layers]).squeeze(0)

    def _run(self, x: Tensor, layers: Sequence[tuple[Tensor, Tensor]]) -> Tensor:
        in_place = None if torch.is_grad_enabled() else _IN_PLACE.get(self.activation)
        activation, last = in_place or self.activation, len(layers) - 1
        # oneDNN's `baddbmm` first copies the bias to every row. With many rows it is faster to add
        # it after the product, which gives the same bits; with the default backend they differ.
        many = in_place and x.shape[1] >= BULK and x.device.type == "cpu"
        bias_last = many and matmul.current() == "onednn"
        for layer, (weight, bias) in enumerate(layers):
            x = torch.bmm(x, weight).add_(bias) if bias_last else torch.baddbmm(bias, x, weight)
            if layer < last:
                x = activation(x)
        return x


def rows_at_once(device: torch.device, in_cache: int) -> int:
    """How many rows to evaluate at once: on a CPU as many as fit its cache."""
    return in_cache if device.type == "cpu" else max(in_cache, GPU_ROWS)


def forward_trace(net: StackedMLP, x: Tensor) -> list[Tensor]:
    """The input (M, B, in) of every layer of a ReLU network over x, last its output (M, B, out)."""
    trace = [x]
    *hidden, (last_weight, last_bias) = net.layers
    for weight, bias in hidden:
        trace.append(torch.baddbmm(bias, trace[-1], weight).relu_())
    return [*trace, torch.baddbmm(last_bias, trace[-1], last_weight)]


def gradients(net: StackedMLP, trace: list[Tensor], grad: Tensor) -> list[Tensor]:
    """Every parameter's gradient, in the order of `net.tensors()`.

    `grad` (M, B, out) is the loss's gradient with respect to the output.
    """
    weights, biases = [], []
    for layer in reversed(range(len(net.layers))):
        weights.append(torch.bmm(trace[layer].mT, grad))
        biases.append(grad.sum(1, keepdim=True))
        if layer:
            grad = _through(net, trace, layer, grad)
    return [*reversed(weights), *reversed(biases)]


def input_gradient(net: StackedMLP, trace: list[Tensor], grad: Tensor) -> Tensor:
    """The loss's gradient with respect to the input, (M, B, in), from that of the output."""
    for layer in reversed(range(1, len(net.layers))):
        grad = _through(net, trace, layer, grad)
    return _times_transposed(grad, net.layers[0][0])


def _through(net: StackedMLP, trace: list[Tensor], layer: int, grad: Tensor) -> Tensor:
    """From the gradient of a layer's output to the previous layer's, before its ReLU."""
    grad = _times_transposed(grad, net.layers[layer][0])
    relu_backward = torch.ops.aten.threshold_backward.grad_input
    return relu_backward(grad, trace[layer], 0, grad_input=grad)


def _times_transposed(grad: Tensor, weight: Tensor) -> Tensor:
    # With a single output the product has one term, and a matrix product is not worth its call.
    return grad * weight.mT if grad.shape[-1] == 1 else torch.bmm(grad, weight.mT)
