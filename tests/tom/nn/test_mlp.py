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


def generators(*seeds: int) -> list[torch.Generator]:
    return [torch.Generator().manual_seed(s) for s in seeds]


def test_stack_equals_each_network_alone():
    net = StackedMLP(3, [4, 8, 2], relu, generators(0, 1, 2))
    x = torch.randn(3, 5, 4)
    out = net(x)
    for m in range(3):
        hidden = relu(linear(x[m], net.weights[0][m].T, net.biases[0][m, 0]))
        alone = linear(hidden, net.weights[1][m].T, net.biases[1][m, 0])
        torch.testing.assert_close(out[m], alone)
        torch.testing.assert_close(net.member(m, x[m]), alone)


def test_a_member_starts_the_same_in_any_company():
    alone = StackedMLP(2, [4, 8, 1], relu, generators(7))
    together = StackedMLP(4, [4, 8, 1], relu, generators(3, 7))
    for a, b in zip(alone.parameters(), together.parameters(), strict=True):
        torch.testing.assert_close(a, b[2:], rtol=0, atol=0)


def test_joined_networks_stay_themselves():
    nets = [StackedMLP(2, [4, 8, 1], relu, generators(s)) for s in (3, 7)]
    x = torch.randn(4, 5, 4)
    apart = torch.cat([net(part) for net, part in zip(nets, x.chunk(2), strict=True)]).detach()
    joint = StackedMLP.joined(nets)
    torch.testing.assert_close(joint(x), apart)
    with torch.no_grad():
        joint.weights[0][2:] += 1.0
    assert torch.equal(nets[1].weights[0], joint.weights[0][2:])
    assert torch.equal(nets[0].weights[0], joint.weights[0][:2])
    torch.testing.assert_close(joint(x)[2:], nets[1](x[2:]))


def test_the_state_of_a_joined_network_is_its_own_alone():
    """A file takes the whole memory behind a view: one member's would hold all members'."""
    nets = [StackedMLP(2, [4, 8, 1], relu, generators(s)) for s in (3, 7)]
    before = [net.own_state() for net in nets]
    StackedMLP.joined(nets)
    for net, state in zip(nets, before, strict=True):
        for name, value in net.own_state().items():
            assert torch.equal(value, state[name])
            assert value.untyped_storage().nbytes() == value.nbytes


@pytest.mark.parametrize("activation", [relu, silu, torch.tanh])
@pytest.mark.parametrize("members", [1, 3])
def test_many_rows_without_a_gradient_are_the_same_rows(
    onednn: None, activation: Activation, members: int
):
    """In bulk the bias is added after oneDNN's product, else before it."""
    net = StackedMLP(members, [6, 64, 64, 3], activation, generators(0))
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
