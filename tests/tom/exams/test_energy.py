"""The energy distance against its formula and against distributions where it is known."""

from math import erf, exp, pi, sqrt

import pytest
import torch
from common import generator
from torch import Tensor

from tom.data.scaling import Scaling
from tom.data.transitions import TensorTransitions
from tom.exams import energy
from tom.exams.energy import (
    drawn_distance,
    energy_distance,
    first_half,
    footprint_match,
    step_scaling,
)


def by_definition(x: Tensor, y: Tensor, p: Tensor | None = None) -> float:
    """2 E|x - y| - E|x - x'| - E|y - y'|, pair by pair, x weighted by p (N,)."""
    p = torch.ones(len(x)) if p is None else p

    def within(z: Tensor, w: Tensor) -> float:
        pairs = [(i, j) for i in range(len(z)) for j in range(len(z)) if i != j]
        total = sum(float(w[i] * w[j]) for i, j in pairs)
        return sum(float(w[i] * w[j] * (z[i] - z[j]).norm()) for i, j in pairs) / total

    cross = sum(float(p[i] * (x[i] - b).norm()) for i in range(len(x)) for b in y)
    return 2 * cross / float(p.sum() * len(y)) - within(x, p) - within(y, torch.ones(len(y)))


def line(x: Tensor, ends: list[int] | None = None) -> TensorTransitions:
    """Transitions from x (N,) that neither act nor move."""
    flat = torch.zeros(len(x))
    terminated = flat.clone()
    terminated[ends or []] = 1.0
    obs, action = x[:, None].float(), flat[:, None]
    return TensorTransitions(obs, action, flat, obs, terminated, flat)


def shifted(m: float) -> float:
    """E of N(0, 1) and N(m, 1)."""
    return 4 / sqrt(pi) * exp(-(m**2) / 4) + 2 * m * erf(m / 2) - 4 / sqrt(pi)


def test_it_is_its_formula():
    x, y = (torch.randn(n, 3, generator=generator(n)).double() for n in (9, 7))
    assert energy_distance(x, y) == pytest.approx(by_definition(x, y), abs=1e-9)
    assert energy_distance(x, y) == pytest.approx(energy_distance(y, x), abs=1e-9)


def test_draws_of_one_part_count_twice_and_a_row_is_no_pair_with_itself():
    x = torch.tensor([[0.0], [0.0], [1.0], [5.0]])
    # Parts (0, 0) and (1, 5): their draws make 4 pairs, 1 and 5 twice; 0 and 0 are one row.
    found = drawn_distance(x, torch.tensor([7, 7, 8, 9]))
    assert float(found) == pytest.approx((1 + 5 + 1 + 5 + 2 * 4) / 6)
    apart = drawn_distance(x, torch.tensor([6, 7, 8, 9]))
    assert float(apart) == pytest.approx((1 + 5 + 1 + 5 + 2 * 4 + 2 * 0) / 8)
    assert not drawn_distance(x[:1].expand(4, 1), torch.zeros(4)).isfinite()


def match(
    buffer: Tensor, weights: Tensor, met: TensorTransitions, seed: int = 0
) -> dict[str, float]:
    scaling = Scaling(torch.zeros(3), torch.ones(3))
    return footprint_match(line(buffer), weights, met, scaling, generator(seed))


def test_weights_that_restore_the_policys_distribution_bring_it_to_zero():
    g = generator()
    old, new, met = (torch.randn(n, generator=g) for n in (3000, 3000, 2000))
    buffer = torch.cat([old, new + 3])
    restored = torch.cat([torch.zeros(3000), torch.ones(3000)])
    reversed_ = restored.flip(0)
    half = line(met + 3)
    # E is 2 E|x - y| - ... of mixtures: a quarter of that between the parts.
    found = match(buffer, restored, half)
    assert found["footprint_uniform"] == pytest.approx(shifted(3) / 4, rel=0.05)
    assert found["footprint"] == pytest.approx(0, abs=0.01)
    assert found["footprint_noise"] == pytest.approx(0, abs=0.01)
    assert match(buffer, reversed_, half)["footprint"] == pytest.approx(4, rel=0.05)


def test_draws_stand_for_the_whole_weighted_buffer():
    g = generator()
    buffer, met = torch.randn(30, generator=g), torch.randn(20, generator=g) + 2
    weights = torch.rand(30, generator=g) ** 2
    found = [match(buffer, weights, line(met), seed) for seed in range(30)]
    uniform = by_definition(buffer[:, None], met[:, None])
    exact = by_definition(buffer[:, None], met[:, None], weights) / uniform
    for name, expected in (("footprint_uniform", uniform), ("footprint", exact)):
        values = torch.tensor([one[name] for one in found])
        error = float(values.std() / len(values) ** 0.5)
        assert float(values.mean()) == pytest.approx(expected, abs=3 * error)
        assert error < 0.01


def test_equal_weights_are_equal_to_the_last_bit():
    buffer = torch.randn(500, generator=generator())
    found = match(buffer, torch.full((500,), 0.7), line(buffer[:40] + 1, list(range(3, 40, 4))))
    assert found["footprint"] == 1.0
    assert found["footprint_se"] == 0.0


@pytest.mark.parametrize(("episodes", "length"), [(200, 1), (40, 5), (5, 40)])
def test_the_standard_error_is_the_spread_over_footprints(
    episodes: int, length: int, monkeypatch: pytest.MonkeyPatch
):
    """Of independent rows, and of many and few episodes that differ; the buffer's draws stay."""
    monkeypatch.setattr(energy, "DRAWS", 300)
    g, found = generator(), []
    buffer, ends = torch.randn(1000, generator=g), list(range(length - 1, 200, length))
    for _ in range(200):
        of_episode = torch.randn(episodes, generator=g).repeat_interleave(length)
        met = 2 + 0.7 * of_episode + 0.3 * torch.randn(200, generator=g)
        found.append(match(buffer, (buffer > 0).float(), line(met, ends)))
    ratio, error = (
        torch.tensor([one[name] for one in found]) for name in ("footprint", "footprint_se")
    )
    assert float(error.square().mean().sqrt()) == pytest.approx(float(ratio.std()), rel=0.25)


@pytest.mark.parametrize("lengths", [[200], [100, 100], [50, 50, 50, 50], [3, 3, 3, 3, 3, 185]])
def test_a_few_episodes_have_no_standard_error(lengths: list[int]):
    """Nor has one long episode beside a few short ones."""
    g = generator()
    buffer, met = torch.randn(300, generator=g), torch.randn(200, generator=g) + 2
    ends = torch.tensor(lengths).cumsum(0) - 1
    found = match(buffer, torch.rand(300, generator=g) ** 2, line(met, ends.tolist()))
    assert "footprint" in found
    assert "footprint_se" not in found


def test_what_cannot_be_measured_is_left_out():
    buffer, ones = torch.randn(50, generator=generator()), torch.ones(50)
    assert match(buffer, ones, line(buffer[:1])) == {}
    assert set(match(buffer, ones, line(buffer[:3] + 9))) == {"footprint", "footprint_uniform"}
    nowhere_near = {"footprint", "footprint_uniform", "footprint_noise"}
    assert set(match(buffer, ones, line(buffer[:4] + 9))) == nowhere_near
    assert set(match(buffer, ones, line(buffer))) == {"footprint_uniform"}  # below zero
    single = (torch.arange(50) == 7).float()
    assert "footprint" not in match(buffer, single, line(buffer[:4] + 9))


def test_halves_are_whole_episodes_of_about_even_length_or_halves_in_time():
    def halves(n: int, ends: list[int]) -> list[int]:
        return first_half(line(torch.zeros(n), ends)).int().tolist()

    assert halves(5, []) == [1, 1, 0, 0, 0]
    assert halves(4, [3]) == [1, 1, 0, 0]
    assert halves(5, [2]) == [1, 1, 1, 0, 0]
    assert halves(9, [1, 6]) == [0, 0, 1, 1, 1, 1, 1, 0, 0]


def test_halves_of_a_thinned_footprint_are_whole_episodes_too():
    """Of 6 000 rows every third is compared, seldom the one that ends an episode."""
    buffer = torch.randn(400, generator=generator())
    noise = []
    for first in (1500, 1501, 1502):  # rows of the first of two episodes, each a slow drift
        x = torch.cat([torch.linspace(0, 5, n) for n in (first, 6000 - first)])
        found = match(buffer, torch.ones(400), line(x, [first - 1, 5999]))
        noise.append(found["footprint_noise"])
    assert noise == pytest.approx([0, 0, 0], abs=0.01)


def test_thinning_keeps_the_scaling_of_a_long_buffer():
    x = torch.randn(50_001, generator=generator()) * 3 + 5
    scaling = step_scaling(line(x))
    assert scaling.mean[0] == pytest.approx(5, abs=0.1)
    assert scaling.std.tolist() == pytest.approx([3, 1, 1], abs=0.1)  # constant columns: left as is
