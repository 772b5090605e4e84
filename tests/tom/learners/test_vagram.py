import pytest
import torch
from common import generator
from made import OBS, context, rows
from torch import Tensor

from tom.config import VagramConfig
from tom.learners.vagram import VagramLearner, clip_rows, value_gradient_weights

LINEAR = torch.tensor([[1.0, -2.0, 0.0], [-1.0, 4.0, 0.0]])  # two heads, V_k(s) = c_k . s


def linear_heads(states: Tensor) -> Tensor:
    return LINEAR[:, None].expand(-1, len(states), -1)


def test_weights_are_squared_scaled_gradients_averaged_over_heads():
    scale = torch.tensor([0.5, 2.0, 3.0])
    found = value_gradient_weights(torch.randn(10, OBS), scale, linear_heads)
    # ((0.5 * 1)^2 + (0.5 * -1)^2) / 2 and ((2 * -2)^2 + (2 * 4)^2) / 2: heads never cancel
    torch.testing.assert_close(found, torch.tensor([0.25, 40.0, 0.0]).expand(10, -1))


def test_the_dimension_that_matters_gets_the_weight():
    replay = rows(500)
    found = VagramLearner(VagramConfig()).weigh(context(replay, value_gradient=linear_heads))
    assert found.ready
    assert found.per_dim is not None
    assert found.per_dim.shape == (500, OBS)
    per_dim = found.per_dim.mean(0)
    variance = (replay.next_obs - replay.obs).var(0, correction=0)
    expected = variance * torch.tensor([1.0, 10.0, 0.0])
    torch.testing.assert_close(per_dim / per_dim.sum(), expected / expected.sum())
    torch.testing.assert_close(found.weights, found.per_dim.mean(1))
    assert float(found.weights.mean()) == pytest.approx(1.0, abs=1e-5)


def test_clipping_bounds_rows_and_keeps_their_proportions():
    g = generator()
    raw = torch.rand(1000, OBS, generator=g) ** 6
    raw[0] *= 1e6
    found = clip_rows(raw, 0.95)
    bound = raw.mean(1).sort().values[950]
    assert float(found.mean(1).max()) == pytest.approx(float(bound), rel=1e-5)
    untouched = raw.mean(1) <= bound
    torch.testing.assert_close(found[untouched], raw[untouched])
    torch.testing.assert_close(found[0] / found[0].sum(), raw[0] / raw[0].sum())
    torch.testing.assert_close(clip_rows(raw, 1.0), raw)


def test_a_dimension_whose_change_is_constant_is_fitted_too():
    """Its unit is one, as in the model's targets: without weight the model would drift there."""
    replay = rows(500)
    replay.next_obs[:, 1] = replay.obs[:, 1]
    weighting = VagramLearner(VagramConfig(clip_quantile=1.0)).weigh(
        context(replay, value_gradient=linear_heads)
    )
    assert weighting.per_dim is not None
    first, still = weighting.per_dim.mean(0)[:2]
    variance = (replay.next_obs - replay.obs)[:, 0].var(correction=0)
    torch.testing.assert_close(still / first, 10 / variance)
