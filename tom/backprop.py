"""Backpropagation through stacked ReLU networks, by hand.

A SAC update is small matrix products and much bookkeeping; without autograd's share of it an
update takes three quarters of the time on a CPU, and the whole of it can be captured as one CUDA
graph. The tests hold every gradient against autograd's.
"""

import torch
from torch import Tensor

from tom.nn import StackedMLP

Trace = list[Tensor]
"""Inputs (M, B, in) of each layer, then the network's output (M, B, out)."""


def forward_trace(net: StackedMLP, x: Tensor) -> Trace:
    """The forward pass of a ReLU network, keeping what the backward pass needs."""
    trace = [x]
    for weight, bias in zip(net.weights, net.biases, strict=True):
        if len(trace) > 1:
            trace[-1].relu_()
        trace.append(torch.baddbmm(bias, trace[-1], weight))
    return trace


def set_gradients(net: StackedMLP, trace: Trace, grad: Tensor) -> None:
    """Set every parameter's `.grad` from the loss's gradient with respect to the output."""
    for layer in reversed(range(len(net.weights))):
        net.weights[layer].grad = torch.bmm(trace[layer].mT, grad)
        net.biases[layer].grad = grad.sum(1, keepdim=True)
        if layer:
            grad = _through_relu(torch.bmm(grad, net.weights[layer].mT), trace[layer])


def input_gradient(net: StackedMLP, trace: Trace, grad: Tensor) -> Tensor:
    """The loss's gradient with respect to the input, (M, B, in), from that of the output."""
    for layer in reversed(range(len(net.weights))):
        grad = torch.bmm(grad, net.weights[layer].mT)
        if layer:
            grad = _through_relu(grad, trace[layer])
    return grad


def _through_relu(grad: Tensor, activated: Tensor) -> Tensor:
    return torch.ops.aten.threshold_backward(grad, activated, 0)
