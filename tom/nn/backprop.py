"""Backpropagation through stacked networks, by hand.

A training step is small matrix products and much bookkeeping; without autograd's share of it a
SAC update takes three quarters of the time on a CPU, and the whole of it can be captured as one
CUDA graph. The tests hold every gradient against autograd's.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import relu, silu

from tom.nn.mlp import Activation, StackedMLP

_aten = torch.ops.aten

_BACKWARD: dict[Activation, Callable[[Tensor, Tensor, Tensor], object]] = {
    # (gradient, layer's raw output, the same activated): turns the gradient in place
    relu: lambda grad, raw, out: _aten.threshold_backward.grad_input(grad, out, 0, grad_input=grad),
    silu: lambda grad, raw, out: _aten.silu_backward.grad_input(grad, raw, grad_input=grad),
    torch.tanh: lambda grad, raw, out: _aten.tanh_backward.grad_input(grad, out, grad_input=grad),
}


@dataclass(frozen=True)
class Trace:
    """A forward pass: what the backward pass needs of it, and its output (M, B, out)."""

    inputs: list[Tensor]  # of each layer, (M, B, in)
    raw: list[Tensor]  # output of each hidden layer before its activation
    output: Tensor


def forward_trace(net: StackedMLP, x: Tensor) -> Trace:
    """The forward pass over x (M, B, in), kept."""
    inputs, raw = [x], []
    *hidden, (last_weight, last_bias) = net.layers
    in_place = net.activation is relu  # its gradient needs no raw outputs
    for weight, bias in hidden:
        out = torch.baddbmm(bias, inputs[-1], weight)
        raw.append(out)
        inputs.append(out.relu_() if in_place else net.activation(out))
    return Trace(inputs, raw, torch.baddbmm(last_bias, inputs[-1], last_weight))


def gradients(net: StackedMLP, trace: Trace, grad: Tensor) -> list[Tensor]:
    """Every parameter's gradient, in the order of `net.tensors()`.

    `grad` (M, B, out) is the loss's gradient with respect to the output.
    """
    weights, biases = [], []
    for layer in reversed(range(len(net.layers))):
        weights.append(torch.bmm(trace.inputs[layer].mT, grad))
        biases.append(grad.sum(1, keepdim=True))
        if layer:
            grad = _through(net, trace, layer, grad)
    return [*reversed(weights), *reversed(biases)]


def input_gradient(net: StackedMLP, trace: Trace, grad: Tensor) -> Tensor:
    """The loss's gradient with respect to the input, (M, B, in), from that of the output."""
    for layer in reversed(range(1, len(net.layers))):
        grad = _through(net, trace, layer, grad)
    return _times_transposed(grad, net.layers[0][0])


def _through(net: StackedMLP, trace: Trace, layer: int, grad: Tensor) -> Tensor:
    """From the gradient of a layer's output to that of the layer's before, unactivated."""
    grad = _times_transposed(grad, net.layers[layer][0])
    _BACKWARD[net.activation](grad, trace.raw[layer - 1], trace.inputs[layer])
    return grad


def _times_transposed(grad: Tensor, weight: Tensor) -> Tensor:
    # Where there is one output the product has one term, and no call of a matrix product pays.
    return grad * weight.mT if grad.shape[-1] == 1 else torch.bmm(grad, weight.mT)
