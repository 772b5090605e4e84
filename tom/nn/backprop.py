"""Backpropagation through stacked networks, by hand.

A training step consists of small matrix products and much bookkeeping. Without autograd's
bookkeeping a SAC update takes three quarters of the time on a CPU and can be captured as one CUDA
graph. The tests compare every gradient with autograd's.
"""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn.functional import relu, silu

from tom.nn.mlp import Activation, StackedMLP

_aten = torch.ops.aten

_BACKWARD: dict[Activation, Callable[[Tensor, Tensor, Tensor], object]] = {
    # (gradient, layer's output before and after the activation): changes the gradient in place
    relu: lambda grad, raw, out: _aten.threshold_backward.grad_input(grad, out, 0, grad_input=grad),
    silu: lambda grad, raw, out: _aten.silu_backward.grad_input(grad, raw, grad_input=grad),
    torch.tanh: lambda grad, raw, out: _aten.tanh_backward.grad_input(grad, out, grad_input=grad),
}


@dataclass(frozen=True)
class Trace:
    """A forward pass: the values that the backward pass needs, and the output (M, B, out)."""

    inputs: list[Tensor]  # of each layer, (M, B, in)
    raw: list[Tensor]  # output of each hidden layer before its activation
    output: Tensor


def forward_trace(net: StackedMLP, x: Tensor) -> Trace:
    """The forward pass over x (M, B, in), with its intermediate values."""
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
    """From the gradient of a layer's output to the previous layer's, before its activation."""
    grad = _times_transposed(grad, net.layers[layer][0])
    _BACKWARD[net.activation](grad, trace.raw[layer - 1], trace.inputs[layer])
    return grad


def _times_transposed(grad: Tensor, weight: Tensor) -> Tensor:
    # With a single output the product has one term, and a matrix product is not worth its call.
    return grad * weight.mT if grad.shape[-1] == 1 else torch.bmm(grad, weight.mT)
