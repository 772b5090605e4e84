from collections.abc import Iterator

import pytest
import torch
from torch.nn.functional import linear, relu, silu

from tom.machine import matmul
from tom.nn.mlp import BULK, GPU_ROWS, Activation, StackedMLP, rows_at_once


@pytest.fixture
def onednn() -> Iterator[None]:
    before = matmul.current()
    matmul.use("onednn")
    yield
    matmul.use(before)


def test_stack_equals_each_network_alone():
    net = StackedMLP(3, [4, 8, 2], relu, torch.Generator().manual_seed(0))
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
    net = StackedMLP(members, [6, 64, 64, 3], activation, torch.Generator().manual_seed(0))
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
