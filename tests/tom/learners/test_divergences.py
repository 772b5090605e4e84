import pytest
import torch
from torch import Tensor

from tom.learners.divergences import (
    DIVERGENCES,
    RELEASED,
    Divergence,
    chi2_conjugate,
    chi2_generator,
    chi2_weights,
    full_chi2_conjugate,
    full_chi2_generator,
    full_chi2_weights,
    kl_dual_term,
    kl_weights,
    released_conjugate,
)

Y = torch.tensor([-30.0, -3.0, -2.0, -1.5, -1.0, -0.5, 0.0, 0.5, 3.0], dtype=torch.float64)
X = torch.linspace(0, 20, 200_001, dtype=torch.float64)


def supremum(f: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """max over the grid x of x y - f(x), for every y."""
    return (x * y[:, None] - f).amax(1)


@pytest.mark.parametrize(
    ("generator", "conjugate"),
    [(chi2_generator, chi2_conjugate), (full_chi2_generator, full_chi2_conjugate)],
)
def test_conjugates_are_suprema_over_non_negative_x(generator, conjugate):
    torch.testing.assert_close(conjugate(Y), supremum(generator(X), X, Y), atol=1e-8, rtol=0)


def test_the_released_conjugate_is_the_supremum_over_every_real_x():
    x = torch.cat((-X.flip(0), X)) * 2
    torch.testing.assert_close(
        released_conjugate(Y), supremum(chi2_generator(x), x, Y), atol=1e-7, rtol=0
    )


def test_clamped_and_released_agree_above_minus_one_and_part_below():
    above, below = Y[Y >= -1], Y[Y < -1]
    torch.testing.assert_close(chi2_conjugate(above), released_conjugate(above))
    assert (chi2_conjugate(below) == -0.5).all()
    assert (released_conjugate(below) > -0.5).all()


@pytest.mark.parametrize(
    ("conjugate", "weights"),
    [(chi2_conjugate, chi2_weights), (full_chi2_conjugate, full_chi2_weights)],
)
def test_weights_are_the_conjugates_slope_and_never_negative(conjugate, weights):
    y = Y.clone().requires_grad_()
    (slope,) = torch.autograd.grad(conjugate(y).sum(), y)
    torch.testing.assert_close(weights(Y), slope)
    assert (weights(Y) >= 0).all()


def test_kl_dual_term_is_the_supremum_over_normalised_weights():
    g = torch.Generator().manual_seed(0)
    y = torch.randn(50, generator=g, dtype=torch.float64)
    f = DIVERGENCES["kl"]

    def value(w: Tensor) -> Tensor:
        return (w * y - f.generator(w)).mean()

    best = kl_weights(y)
    assert best.mean() == pytest.approx(1.0)
    assert value(best) == pytest.approx(float(kl_dual_term(y)))
    for _ in range(20):
        other = torch.rand(50, generator=g, dtype=torch.float64)
        assert value(other / other.mean()) < kl_dual_term(y)


def test_kl_is_stable_where_the_exponential_overflows():
    y = torch.tensor([1000.0, 1001.0, -1000.0])
    assert torch.isfinite(kl_dual_term(y))
    torch.testing.assert_close(kl_weights(y), 3 * torch.tensor([0.268941, 0.731059, 0.0]))


def test_kl_at_zero_weight_is_zero():
    assert DIVERGENCES["kl"].generator(torch.zeros(1)) == 0


def test_full_chi2_bounds_kl_and_half_of_it_does_not():
    x = torch.linspace(0, 5, 501, dtype=torch.float64)
    kl = DIVERGENCES["kl"].generator(x) - x + 1  # the same divergence, made non-negative
    assert (full_chi2_generator(x) >= kl - 1e-12).all()
    assert (chi2_generator(x) < kl - 1e-3).any()


@pytest.mark.parametrize("name", DIVERGENCES)
def test_each_divergence_is_zero_at_equal_distributions(name):
    f = DIVERGENCES[name]
    assert isinstance(f, Divergence)
    assert f.generator(torch.ones(3)).abs().max() == 0
    torch.testing.assert_close(f.weights(torch.zeros(5)), torch.ones(5))
    assert float(f.dual_term(torch.zeros(5))) == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("name", DIVERGENCES)
def test_the_multiplier_gives_mean_weight_one_and_the_least_dual(name):
    f = DIVERGENCES[name]
    y = 4 * torch.randn(3, 500, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    best = f.multiplier(y)
    for row, value in zip(y, best, strict=True):
        assert float(f.weights(row - value).mean()) == pytest.approx(1.0, abs=1e-9)

    def dual(shift: float) -> Tensor:
        return best + shift + f.dual_term(y - best[:, None] - shift)

    for shift in (-0.3, -1e-3, 1e-3, 0.3):
        assert (dual(shift) >= dual(0.0) - 1e-12).all()


def test_the_multiplier_of_a_batch_with_one_active_row():
    y = torch.tensor([100.0, 0.0, 0.0, 0.0])
    assert float(DIVERGENCES["chi2"].multiplier(y)) == pytest.approx(97.0)  # its weight is 4


@pytest.mark.parametrize("name", ["chi2", "full-chi2"])
def test_the_multiplier_of_a_batch_that_is_not_finite_is_not_finite_either(name):
    """And beside it the others have theirs, as many are found at once."""
    f, fine = DIVERGENCES[name], torch.tensor([1.0, -5.0, 2.0])
    for bad in (torch.nan, torch.inf):
        found = f.multiplier(torch.stack((torch.tensor([0.0, bad, 1.0]), fine)))
        assert not found[0].isfinite()
        assert found[1] == f.multiplier(fine)


def test_the_multiplier_of_a_number_beyond_float64s_whole_ones():
    y = torch.tensor([1e17, 0.0, 0.0])
    assert float(DIVERGENCES["chi2"].multiplier(y)) == pytest.approx(1e17)


def test_the_released_parabola_has_mean_slope_one():
    y = torch.tensor([1.0, -5.0, 2.0])
    shifted = y - RELEASED.multiplier(y)
    assert float((1 + shifted).mean()) == pytest.approx(1.0, abs=1e-6)
