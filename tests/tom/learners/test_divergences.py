"""The divergences against their definitions: suprema over a grid, minima over a line."""

import pytest
import torch
from common import generator
from torch import Tensor

from tom.learners.terms import DIVERGENCES, RELEASED, chi2_conjugate, released_conjugate

Y = torch.tensor([-30.0, -3.0, -2.0, -1.5, -1.0, -0.5, 0.0, 0.5, 3.0], dtype=torch.float64)
X = torch.linspace(0, 20, 200_001, dtype=torch.float64)


GENERATORS = {
    "chi2": lambda x: (x - 1).square() / 2,
    "full-chi2": lambda x: (x - 1).square(),
    "kl": lambda x: torch.special.xlogy(x, x),
}
"""f by name"""


def supremum(f: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """max over the grid x of x y - f(x), for every y."""
    return (x * y[:, None] - f).amax(1)


@pytest.mark.parametrize("name", ["chi2", "full-chi2"])
def test_the_dual_term_is_the_supremum_over_non_negative_x_and_the_weights_its_slope(name: str):
    f, y = DIVERGENCES[name], Y[:, None].clone().requires_grad_()
    conjugate = f.dual_term(y)
    expected = supremum(GENERATORS[name](X), X, Y)
    torch.testing.assert_close(conjugate.detach(), expected, atol=1e-8, rtol=0)
    (slope,) = torch.autograd.grad(conjugate.sum(), y)
    torch.testing.assert_close(f.weights(Y), slope[:, 0])
    assert (f.weights(Y) >= 0).all()


def test_the_released_conjugate_is_the_supremum_over_every_real_x():
    x = torch.cat((-X.flip(0), X)) * 2
    found = supremum(GENERATORS["chi2"](x), x, Y)
    torch.testing.assert_close(released_conjugate(Y), found, atol=1e-7, rtol=0)
    above, below = Y[Y >= -1], Y[Y < -1]  # they part below -1
    torch.testing.assert_close(chi2_conjugate(above), released_conjugate(above))
    assert (chi2_conjugate(below) == -0.5).all()


def test_kl_dual_term_is_the_supremum_over_normalised_weights():
    g = generator()
    y = torch.randn(50, generator=g, dtype=torch.float64)
    f = DIVERGENCES["kl"]

    def value(w: Tensor) -> Tensor:
        return (w * y - GENERATORS["kl"](w)).mean()

    best = f.weights(y)
    assert best.mean() == pytest.approx(1.0)
    assert value(best) == pytest.approx(float(f.dual_term(y)))
    for _ in range(20):
        other = torch.rand(50, generator=g, dtype=torch.float64)
        assert value(other / other.mean()) < f.dual_term(y)


def test_kl_is_stable_where_the_exponential_overflows():
    y, f = torch.tensor([1000.0, 1001.0, -1000.0]), DIVERGENCES["kl"]
    assert torch.isfinite(f.dual_term(y))
    torch.testing.assert_close(f.weights(y), 3 * torch.tensor([0.268941, 0.731059, 0.0]))


@pytest.mark.parametrize("name", DIVERGENCES)
def test_the_multiplier_gives_mean_weight_one_and_the_least_dual(name):
    f = DIVERGENCES[name]
    y = 4 * torch.randn(3, 500, generator=generator(), dtype=torch.float64)
    best = f.multiplier(y)
    for row, value in zip(y, best, strict=True):
        assert float(f.weights(row - value).mean()) == pytest.approx(1.0, abs=1e-9)

    def dual(shift: float) -> Tensor:
        return best + shift + f.dual_term(y - best[:, None] - shift)

    for shift in (-0.3, -1e-3, 1e-3, 0.3):
        assert (dual(shift) >= dual(0.0) - 1e-12).all()


@pytest.mark.parametrize(("y", "multiplier"), [([100.0, 0, 0, 0], 97), ([1e17, 0, 0], 1e17)])
def test_the_multiplier_of_a_batch_with_one_active_row(y: list[float], multiplier: float):
    """Its weight is their number; the second is beyond float64's whole numbers."""
    assert float(DIVERGENCES["chi2"].multiplier(torch.tensor(y))) == pytest.approx(multiplier)


@pytest.mark.parametrize("name", ["chi2", "full-chi2"])
def test_the_multiplier_of_a_batch_that_is_not_finite_is_not_finite_either(name):
    """And beside it the others have theirs, as many are found at once."""
    f, fine = DIVERGENCES[name], torch.tensor([1.0, -5.0, 2.0])
    for bad in (torch.nan, torch.inf):
        found = f.multiplier(torch.stack((torch.tensor([0.0, bad, 1.0]), fine)))
        assert not found[0].isfinite()
        assert found[1] == f.multiplier(fine)


def test_the_released_parabola_has_mean_slope_one():
    y = torch.tensor([1.0, -5.0, 2.0])
    shifted = y - RELEASED.multiplier(y)
    assert float((1 + shifted).mean()) == pytest.approx(1.0, abs=1e-6)
