from collections.abc import Callable

import torch
from torch import Tensor

from tom.road.measure import GRID, interpolation, planned


def test_interpolation_is_exact_for_a_bilinear_function():
    axis = torch.linspace(0, 1, GRID)
    y, x = torch.meshgrid(axis, axis, indexing="ij")
    table = (2 * x - y + 3 * x * y).reshape(-1)
    points = torch.rand(500, 2, generator=torch.Generator().manual_seed(0))
    points = torch.cat([points, torch.tensor([[0.0, 0.0], [1.0, 1.0], [1.0, 0.0]])])
    px, py = points.unbind(-1)
    found = interpolation(points)(table)
    torch.testing.assert_close(found, 2 * px - py + 3 * px * py, atol=2e-3, rtol=0)


def plan(step: float) -> tuple[Tensor, Callable[[Tensor], Tensor]]:
    """To the right-hand edge, each step costing 1; `step` is what an action of 1 does."""
    return planned(
        lambda obs, action: obs + step * action,
        lambda obs: -torch.ones(len(obs)),
        lambda obs: obs[:, 0] >= 0.999,
        discount=0.9,
    )


def test_values_are_discounted_step_counts():
    """Moving 0.1 a step, x = 0.7 is 3 steps from the edge: V = -(1 + 0.9 + 0.81)."""
    value = plan(0.1)[0].view(GRID, GRID)
    for steps, column in ((1, 45), (3, 35), (8, 10)):
        expected = -(1 - 0.9**steps) / 0.1
        torch.testing.assert_close(
            value[:, column], torch.full((GRID,), expected), atol=1e-3, rtol=0
        )


def test_the_greedy_policy_goes_the_shortest_way():
    obs = torch.tensor([[0.31, 0.5], [0.51, 0.07]])
    assert plan(0.1)[1](obs)[:, 0].tolist() == [1.0, 1.0]
    assert plan(-0.1)[1](obs)[:, 0].tolist() == [-1.0, -1.0]
