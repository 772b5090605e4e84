"""The road-and-rocks scene as arrays: columns, ground, stones, lines. Pure functions."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from app.data.road import CELLS, RoadShape, cell_centres, on_road
from app.figures.scales import OCTAVES, octaves
from app.scenes.colours import on_scale
from app.theme import COLUMNS, Mode

GROUND_PIXELS = 400
BOULDERS = 240
TALLEST = 0.13
"""height of a column whose weight is 16 times the uniform one or more"""
_ROAD = {"light": (196, 201, 212), "dark": (66, 73, 90)}
_ROCK = {"light": (226, 221, 213), "dark": (38, 38, 44)}


@dataclass(frozen=True)
class Columns:
    """One column for each cell with a visible weight."""

    position: NDArray[np.float32]  # (C, 3)
    scale: NDArray[np.float32]  # (C, 3)
    colour: NDArray[np.uint8]  # (C, 3)


def columns(grid: NDArray[np.float64], mode: Mode) -> Columns:
    """The weights as columns, with square-root heights so that light cells are visible."""
    y, x = np.nonzero(np.nan_to_num(grid) >= 2**-OCTAVES)
    weight = grid[y, x]
    height = TALLEST * np.sqrt(np.minimum(weight, 2**OCTAVES) / 2**OCTAVES)
    middle = cell_centres()
    return Columns(
        position=np.stack([middle[x], middle[y], height / 2], -1).astype(np.float32),
        scale=np.stack([np.full(len(x), 0.86 / CELLS)] * 2 + [height], -1).astype(np.float32),
        colour=on_scale(octaves(weight) / (2 * OCTAVES) + 0.5, COLUMNS[mode]),
    )


def flat(grid: NDArray[np.float64], mode: Mode) -> NDArray[np.uint8]:
    """The weights as a picture (CELLS, CELLS, 4), row 0 at the lowest y, empty cells clear."""
    known = np.isfinite(grid)
    share = octaves(np.where(known, grid, 1.0)) / (2 * OCTAVES) + 0.5
    alpha = np.where(known, 235, 0).astype(np.uint8)
    return np.concatenate([on_scale(share, COLUMNS[mode]), alpha[..., None]], -1)


def ground(road: RoadShape, mode: Mode) -> NDArray[np.uint8]:
    """The map's floor: (GROUND_PIXELS, GROUND_PIXELS, 3), row 0 at the lowest y."""
    middle = (np.arange(GROUND_PIXELS) + 0.5) / GROUND_PIXELS
    x, y = np.meshgrid(middle, middle)
    inside = on_road(np.stack([x.ravel(), y.ravel()], -1), road).reshape(x.shape)
    grain = np.random.default_rng(0).normal(0, 3, x.shape)[..., None]
    floor = np.where(inside[..., None], _ROAD[mode], _ROCK[mode]) + grain
    return floor.clip(0, 255).astype(np.uint8)


def boulders(road: RoadShape) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Positions (K, 3) and sizes (K,) of stones beside the road, the same in every call."""
    draw = np.random.default_rng(3)
    places = draw.uniform(0.01, 0.99, (4 * BOULDERS, 2))
    size = draw.uniform(0.004, 0.013, 4 * BOULDERS)
    off = ~on_road(
        places, RoadShape(road.centre_line, road.half_width + 0.02, road.start, road.goal)
    )
    places, size = places[off][:BOULDERS], size[off][:BOULDERS]
    return np.column_stack([places, size * 0.35]).astype(np.float32), size.astype(np.float32)


def segments(lines: Sequence[NDArray], height: float) -> NDArray[np.float32]:
    """Polylines (K, 2) as line segments (S, 2, 3) at a height."""
    parts = [np.stack([line[:-1], line[1:]], 1) for line in lines if len(line) > 1]
    flat = np.concatenate(parts) if parts else np.zeros((0, 2, 2))
    return np.concatenate([flat, np.full((*flat.shape[:2], 1), height)], -1).astype(np.float32)


def arrows(points: NDArray, moves: NDArray, height: float) -> NDArray[np.float32]:
    """Arrows (G, 2, 3) from points along displacements, at a height."""
    ends = np.stack([points, points + moves], 1)
    return np.concatenate([ends, np.full((*ends.shape[:2], 1), height)], -1).astype(np.float32)


def dashes(line: NDArray, length: float = 0.02) -> list[NDArray]:
    segments = []
    for a, b in pairwise(line):
        steps = np.arange(0, np.linalg.norm(b - a), 2 * length) / np.linalg.norm(b - a)
        share = length / np.linalg.norm(b - a)
        segments += [np.stack([a + s * (b - a), a + min(s + share, 1) * (b - a)]) for s in steps]
    return segments
