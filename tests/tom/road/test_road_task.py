import math

import pytest
import torch
from common import generator

from tom.road import task


def one(x: float, y: float) -> torch.Tensor:
    return torch.tensor([[x, y]])


@pytest.mark.parametrize(
    ("point", "arc", "distance"),
    [
        ((0.10, 0.12), 0.0, 0.0),
        ((0.50, 0.15), 0.40, 0.03),
        ((0.88, 0.12), 0.78, 0.0),
        ((0.92, 0.50), 1.16, 0.04),
        ((0.04, 0.20), 0.0, 0.10),  # behind the start
        ((0.95, 0.05), 0.78, math.hypot(0.07, 0.07)),  # outside the bend
        ((0.88, 0.98), 1.56, 0.08),  # beyond the end
    ],
)
def test_projection_on_the_centre_line(point, arc, distance):
    found_arc, found_distance = task.project(one(*point))
    assert found_arc.item() == pytest.approx(arc, abs=1e-6)
    assert found_distance.item() == pytest.approx(distance, abs=1e-6)
    assert pytest.approx(1.56) == task.ROAD_LENGTH


def test_the_road_is_about_thirty_percent_of_the_map_and_ends_at_its_edge():
    points = torch.rand(100_000, 2, generator=generator())
    assert task.on_road(points).float().mean().item() == pytest.approx(0.305, abs=0.01)
    inside, outside = one(0.5, 0.12 + 0.0899), one(0.5, 0.12 + 0.0901)
    assert task.on_road(inside).item()
    assert not task.on_road(outside).item()


def test_reward_by_hand():
    """-(1 - arc / length) - min((distance / 0.09)^2, 1)."""
    points = torch.tensor([[0.10, 0.12], [0.49, 0.165], [0.88, 0.90], [0.5, 0.9]])
    expected = [-1.0, -(1 - 0.39 / 1.56) - 0.25, 0.0, -(1 - 1.56 / 1.56) - 1.0]
    # (0.5, 0.9) is 0.38 from the second leg's end and 0.78 from the first leg.
    assert task.reward(points).tolist() == pytest.approx(expected, abs=1e-5)


def test_both_sides_of_the_road_edge():
    """An action moves the car as it should just inside, turned and scaled just outside."""
    rocks = task.RoadMap(torch.full((10, 10), 0.5), torch.full((10, 10), math.pi / 2))
    action = one(1.0, 0.5)
    inside = task.displacement(rocks, one(0.5, 0.2099), action)
    outside = task.displacement(rocks, one(0.5, 0.2101), action)
    torch.testing.assert_close(inside, one(0.04, 0.02))
    torch.testing.assert_close(outside, one(-0.01, 0.02))  # turned left by 90 degrees, halved


def test_rocks_turn_by_the_cell_row_y_and_column_x():
    angle = torch.zeros(10, 10)
    angle[7, 2] = math.pi
    rocks = task.RoadMap(torch.ones(10, 10), angle)
    points = torch.tensor([[0.25, 0.75], [0.75, 0.45], [0.25, 0.65]])
    moved = task.displacement(rocks, points, torch.tensor([[1.0, 0.0]]).expand(3, 2))
    torch.testing.assert_close(moved[:, 0], torch.tensor([-0.04, 0.04, 0.04]))


def test_rocks_are_drawn_within_their_bounds():
    rocks = task.draw_map(turn=120.0, spread=30.0, generator=generator(3))
    degrees = rocks.angle.rad2deg()
    assert 90 <= degrees.min() < 100
    assert 140 < degrees.max() <= 150
    assert 0.5 <= rocks.gain.min() < 0.6
    assert 1.4 < rocks.gain.max() <= 1.5
    assert torch.equal(rocks.gain, task.draw_map(120.0, 30.0, generator(3)).gain)


def test_a_step_adds_noise_and_stays_on_the_map():
    rocks = task.draw_map(180.0, 90.0, generator())
    start = one(0.3, 0.12).expand(20_000, 2)
    moved = task.step(rocks, start, torch.zeros_like(start), generator()) - start
    assert moved.mean(0).abs().max() < 1e-4
    assert moved.std(0).tolist() == pytest.approx([0.002, 0.002], rel=0.03)
    far = task.step(
        rocks, torch.rand(1000, 2, generator=generator()), 9 * start[:1000], generator()
    )
    assert far.min() >= 0
    assert far.max() <= 1


def test_starts_fill_a_small_disc():
    starts = task.start_states(5000, generator())
    distance = (starts - torch.tensor([0.10, 0.12])).norm(dim=1)
    assert 0.019 < distance.max() <= 0.02 + 1e-6
    assert (distance < 0.01).float().mean().item() == pytest.approx(0.25, abs=0.03)


def test_the_expert_follows_the_line_at_full_speed():
    assert task.expert_action(one(0.3, 0.12)).tolist() == [[1.0, 0.0]]
    assert task.expert_action(one(0.88, 0.4)).tolist()[0] == pytest.approx([0.0, 1.0], abs=1e-4)
    assert task.expert_action(one(0.3, 0.14)).tolist()[0] == pytest.approx([1.0, -0.5], abs=1e-4)
