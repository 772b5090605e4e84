"""Road-and-rocks: a car on a road through rocks (paper, section 5.1).

The map is the unit square. On the road the car moves by the action; on the rocks the action is
turned and scaled, differently in each cell of a grid. All functions here are pure, of batches of
positions (B, 2) and actions (B, 2).
"""

from dataclasses import dataclass
from math import pi, radians

import torch
from torch import Tensor

CENTRE_LINE = ((0.10, 0.12), (0.88, 0.12), (0.88, 0.90))
HALF_WIDTH = 0.09
"""maximum distance of the road from its centre line"""
START_RADIUS = 0.02
GOAL_RADIUS = 0.07
STEP = 0.04
"""displacement under an action of 1: a full step"""
NOISE = 0.002
"""standard deviation of the displacement's noise in each axis"""
LOOKAHEAD = 0.05
"""distance along the centre line at which the expert aims"""
CELLS = 10
"""the rocks' grid is CELLS x CELLS"""
MAX_STEPS = 80
OBS_DIM = 2
ACTION_DIM = 2

_LINE = torch.tensor(CENTRE_LINE)  # (P, 2)
_SEGMENTS = _LINE[1:] - _LINE[:-1]  # (P - 1, 2)
_LENGTHS = _SEGMENTS.norm(dim=-1)  # (P - 1,)
_OFFSETS = _LENGTHS.cumsum(0) - _LENGTHS  # (P - 1,) arc length at a segment's first point
ROAD_LENGTH = float(_LENGTHS.sum())
START = _LINE[0]
GOAL = _LINE[-1]


@dataclass(frozen=True)
class RoadMap:
    """The rocks of one map, by cell [row (y), column (x)]."""

    gain: Tensor  # (CELLS, CELLS), in [0.5, 1.5]
    angle: Tensor  # (CELLS, CELLS), radians, anticlockwise


def draw_map(turn: float, spread: float, generator: torch.Generator) -> RoadMap:
    """A map whose rocks turn the steering by `turn` +- `spread` degrees (uniform) and scale it."""
    gain = 0.5 + torch.rand(CELLS, CELLS, generator=generator)
    offset = 2 * torch.rand(CELLS, CELLS, generator=generator) - 1
    return RoadMap(gain, radians(turn) + radians(spread) * offset)


def project(obs: Tensor) -> tuple[Tensor, Tensor]:
    """Arc length (B,) of the nearest point of the centre line, and the distance (B,) to it."""
    offset = obs[:, None] - _LINE[:-1]  # (B, P - 1, 2)
    share = ((offset * _SEGMENTS).sum(-1) / _LENGTHS.square()).clamp(0, 1)  # (B, P - 1)
    distance, nearest = (offset - share[..., None] * _SEGMENTS).norm(dim=-1).min(dim=-1)
    arc = _OFFSETS[nearest] + share.gather(1, nearest[:, None])[:, 0] * _LENGTHS[nearest]
    return arc, distance


def point_at(arc: Tensor) -> Tensor:
    """The point (B, 2) of the centre line at arc length (B,), clamped to its ends."""
    share = ((arc[:, None] - _OFFSETS) / _LENGTHS).clamp(0, 1)  # (B, P - 1)
    return _LINE[0] + (share[..., None] * _SEGMENTS).sum(1)


def on_road(obs: Tensor) -> Tensor:
    """A mask (B,) of the positions on the road."""
    return project(obs)[1] <= HALF_WIDTH


def displacement(road_map: RoadMap, obs: Tensor, action: Tensor) -> Tensor:
    """Mean displacement 0.04 M(s) a, (B, 2): M is 1 on the road, a scaled rotation on rocks."""
    column, row = (obs * CELLS).long().clamp(0, CELLS - 1).unbind(-1)
    gain, angle = road_map.gain[row, column], road_map.angle[row, column]
    x, y = action.unbind(-1)
    cos, sin = angle.cos(), angle.sin()
    turned = gain[:, None] * torch.stack([cos * x - sin * y, sin * x + cos * y], -1)
    return STEP * torch.where(on_road(obs)[:, None], action, turned)


def step(road_map: RoadMap, obs: Tensor, action: Tensor, generator: torch.Generator) -> Tensor:
    """The next positions (B, 2): clip(s + 0.04 M(s) a + noise, 0, 1), with a in [-1, 1]."""
    noise = NOISE * torch.randn(obs.shape, generator=generator)
    return (obs + displacement(road_map, obs, action.clamp(-1, 1)) + noise).clamp(0, 1)


def reward(next_obs: Tensor) -> Tensor:
    """Reward (B,) of arriving: -(1 - arc / road length) - min((distance / half width)^2, 1)."""
    arc, distance = project(next_obs)
    return arc / ROAD_LENGTH - 1 - (distance / HALF_WIDTH).square().clamp(max=1)


def at_goal(next_obs: Tensor) -> Tensor:
    """A mask (B,) of the positions at the goal, which ends the episode."""
    return (next_obs - GOAL).norm(dim=-1) <= GOAL_RADIUS


def start_states(count: int, generator: torch.Generator) -> Tensor:
    """Draws (count, 2) of the start distribution: uniform in a disc at the road's beginning."""
    radius, turn = torch.rand(2, count, generator=generator)
    direction = torch.stack([(2 * pi * turn).cos(), (2 * pi * turn).sin()], -1)
    return START + START_RADIUS * radius.sqrt()[:, None] * direction


def expert_aim(obs: Tensor) -> Tensor:
    """The vector (B, 2) to the centre line's point LOOKAHEAD ahead, in full steps, unclipped."""
    arc, _ = project(obs)
    return (point_at(arc + LOOKAHEAD) - obs) / STEP


def expert_action(obs: Tensor) -> Tensor:
    """The expert's steering (B, 2): it follows the centre line at full speed."""
    return expert_aim(obs).clamp(-1, 1)
