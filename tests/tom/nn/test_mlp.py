"""Stacked networks, their gradients by hand, and Adam."""

from collections.abc import Iterator

import pytest
import torch
from common import generator
from torch.nn.functional import linear, relu, silu

from tom.machine import matmul
from tom.nn.mlp import (
    BULK,
    GPU_ROWS,
    Activation,
    StackedMLP,
    forward_trace,
    gradients,
    input_gradient,
    rows_at_once,
)
from tom.nn.trained import Adam


@pytest.fixture
def onednn() -> Iterator[None]:
    before = matmul.current()
    matmul.use("onednn")
    yield
    matmul.use(before)


def test_stack_equals_each_network_alone():
    net = StackedMLP(3, [4, 8, 2], relu, generator())
    x = torch.randn(3, 5, 4)
    out = net(x)
    for m in range(3):
        hidden = relu(linear(x[m], net.weights[0][m].T, net.biases[0][m, 0]))
        alone = linear(hidden, net.weights[1][m].T, net.biases[1][m, 0])
        torch.testing.assert_close(out[m], alone)
        torch.testing.assert_close(net.member(m, x[m]), alone)


@pytest.mark.parametrize("activation", [relu, silu, torch.tanh])
@pytest.mark.parametrize("members", [1, 3])
def test_many_rows_without_a_gradient_are_the_same_rows(
    onednn: None, activation: Activation, members: int
):
    """In bulk the bias is added after oneDNN's product, else before it."""
    net = StackedMLP(members, [6, 64, 64, 3], activation, generator())
    x = torch.randn(members, BULK + 32, 6)
    with torch.no_grad():
        at_once = net(x)
        in_pieces = torch.cat([net(part) for part in x.split(BULK // 2, 1)], 1)
    torch.testing.assert_close(at_once, in_pieces, rtol=0, atol=1e-6)
    torch.testing.assert_close(at_once, net(x).detach(), rtol=0, atol=1e-6)


def test_a_gpu_evaluates_more_rows_at_once():
    assert rows_at_once(torch.device("cpu"), 2000) == 2000
    assert rows_at_once(torch.device("cuda"), 2000) == GPU_ROWS
    assert rows_at_once(torch.device("cuda"), 2 * GPU_ROWS) == 2 * GPU_ROWS


@pytest.mark.parametrize("outputs", [1, 3])
def test_gradients_are_autograds(outputs: int):
    g = generator()
    net = StackedMLP(2, [4, 16, 16, outputs], relu, g).double()
    x = torch.randn(2, 32, 4, generator=g).double().requires_grad_()
    slope = torch.randn(2, 32, outputs, generator=g).double()
    output = net(x)
    expected = torch.autograd.grad(output, [*net.tensors(), x], slope)
    with torch.no_grad():
        trace = forward_trace(net, x.detach())
        found = [*gradients(net, trace, slope), input_gradient(net, trace, slope)]
    torch.testing.assert_close(trace[-1], output.detach())
    for a, b in zip(found, expected, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-5, atol=1e-12)


def tensors(seed: int, members: int = 1) -> list[torch.Tensor]:
    g = generator(seed)
    return [torch.randn(members, 5, 3, generator=g), torch.randn(members, 1, 3, generator=g)]


def test_adam_is_torchs_own_with_its_weight_decay():
    ours, theirs = tensors(0), tensors(0)
    adam = Adam(ours, 1e-2, [0.0, 0.3])
    groups = [{"params": [theirs[0]]}, {"params": [theirs[1]], "weight_decay": 0.3}]
    reference = torch.optim.Adam(groups, lr=1e-2, fused=True)
    for step in range(5):
        gradients = tensors(step + 1)
        gradients[0] = gradients[0].mT.contiguous().mT  # other strides than the parameter's
        for tensor, gradient in zip(theirs, gradients, strict=True):
            tensor.grad = gradient.contiguous()
        reference.step()
        adam.step(gradients)
        assert all(torch.equal(a, b) for a, b in zip(ours, theirs, strict=True))
