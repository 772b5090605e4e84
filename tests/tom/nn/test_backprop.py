import pytest
import torch
from torch.nn.functional import relu

from tom.nn.mlp import StackedMLP, forward_trace, gradients, input_gradient


@pytest.mark.parametrize("outputs", [1, 3])
def test_gradients_are_autograds(outputs: int):
    generator = torch.Generator().manual_seed(0)
    net = StackedMLP(2, [4, 16, 16, outputs], relu, generator).double()
    x = torch.randn(2, 32, 4, generator=generator).double().requires_grad_()
    slope = torch.randn(2, 32, outputs, generator=generator).double()
    output = net(x)
    expected = torch.autograd.grad(output, [*net.tensors(), x], slope)
    with torch.no_grad():
        trace = forward_trace(net, x.detach())
        found = [*gradients(net, trace, slope), input_gradient(net, trace, slope)]
    torch.testing.assert_close(trace[-1], output.detach())
    for a, b in zip(found, expected, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-5, atol=1e-12)
