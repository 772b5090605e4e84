"""Road-and-rocks for both the 2D map and the 3D scene: the record of a fit, and the geometry."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from app.data import buffer
from app.data.cache import cached
from app.data.readers import fresh_reader
from tom.record.reader import RunReader, at_or_before

CELLS = 40
"""the heatmap has CELLS x CELLS cells, with about six random transitions in each"""
OUTLINE_POINTS = 24


@dataclass(frozen=True)
class RoadShape:
    """The content of `fields/map`: the road's shape, its start and its goal (x, y, radius)."""

    centre_line: NDArray[np.float32]  # (P, 2)
    half_width: float
    start: NDArray[np.float32]  # (3,)
    goal: NDArray[np.float32]  # (3,)

    @classmethod
    def of(cls, arrays: Mapping[str, NDArray]) -> "RoadShape":
        """From a run's `map` picture. Raises KeyError if a part is missing."""
        width = float(arrays["road_half_width"])
        return cls(arrays["centre_line"], width, arrays["start"], arrays["goal"])


@dataclass(frozen=True)
class Picture:
    """The data of one fit."""

    learner: str
    step: int
    road: RoadShape
    grid: NDArray[np.float64]  # (CELLS, CELLS) mean weight, row 0 at the lowest y
    expert: list[NDArray]  # (H + 1, 2) each
    learnt: list[NDArray]  # (H + 1, 2) each
    points: NDArray  # (G, 2)
    true: NDArray  # (G, 2) displacements under the expert's action
    modelled: NDArray  # (G, 2)


def steps(run: RunReader) -> list[int]:
    """The fits that can be shown, because their single weights were stored."""
    return run.snapshot_steps() if run.field_steps("map") else []


# A training writes the snapshot first, and the pictures a moment later.
@cached("snapshot", "pictures")
def picture(run: RunReader, step: int) -> Picture | None:
    """The fit at `step`; None if the run's folder lacks the map."""
    part = fresh_reader(run)

    def latest(name: str) -> dict[str, NDArray]:
        recorded = part.field_steps(name)
        return part.field(name, at_or_before(recorded, step)) if recorded else {}

    try:
        road = RoadShape.of(latest("map"))
    except KeyError:
        return None
    weight = part.snapshot(step)["weight"].to_numpy(np.float32)
    obs = np.asarray(buffer.recorded(run).rows.obs)[: len(weight)].reshape(-1, 2)
    model, lines, nothing = latest("model"), latest("trajectories"), np.zeros((0, 2), np.float32)
    moves = {name: model.get(name, nothing) for name in ("points", "true", "modelled")}
    expert, learnt = (trajectories(lines, kind) for kind in ("expert", "learnt"))
    grid = weight_grid(obs, weight[: len(obs)])
    return Picture(run.learner, step, road, grid, expert, learnt, **moves)


def fit(run: RunReader, step: int) -> Picture | None:
    """The fit at `step`, else the last one before; None if none is recorded or it is damaged."""
    recorded = steps(run)
    return picture(run, at_or_before(recorded, step)) if recorded else None


def trajectories(arrays: Mapping[str, NDArray], kind: str) -> list[NDArray]:
    """The driven lines (H + 1, 2) of a kind, `expert` or `learnt`, in order."""
    names = [name for name in arrays if name.startswith(f"{kind}_")]
    return [arrays[name] for name in sorted(names, key=lambda name: int(name.split("_")[1]))]


def distance_to_road(points: NDArray, centre_line: NDArray) -> NDArray[np.float64]:
    """Distance (N,) of points (N, 2) to the nearest point of the centre line (P, 2)."""
    first, along = centre_line[:-1], np.diff(centre_line, axis=0)  # (P - 1, 2)
    offset = points[:, None] - first  # (N, P - 1, 2)
    share = np.clip((offset * along).sum(-1) / np.square(along).sum(-1), 0, 1)
    return np.linalg.norm(offset - share[..., None] * along, axis=-1).min(-1)


def on_road(points: NDArray, road: RoadShape, margin: float = 0.0) -> NDArray[np.bool_]:
    """A mask (N,) of the points (N, 2) on the road, or at most `margin` beside it."""
    return distance_to_road(points, road.centre_line) <= road.half_width + margin


def weight_grid(obs: NDArray, weight: NDArray) -> NDArray[np.float64]:
    """Mean weight of the transitions that start in each cell of the unit square.

    (N, 2), (N,) -> (CELLS, CELLS), row 0 at the lowest y; NaN in an empty cell.
    """
    y, x = np.clip((np.asarray(obs) * CELLS).astype(int), 0, CELLS - 1).T[::-1]
    count, total = np.zeros((2, CELLS, CELLS))
    np.add.at(count, (y, x), 1)
    np.add.at(total, (y, x), np.asarray(weight, np.float64))
    return np.divide(total, count, out=np.full_like(total, np.nan), where=count > 0)


CENTRES = (np.arange(CELLS) + 0.5) / CELLS
"""the coordinates of the cells' centres along one side"""


def outline(road: RoadShape) -> NDArray[np.float64]:
    """The road's edge: a closed line (K, 2) around the points within its half width."""
    edge = np.concatenate(
        [_left_of(line, road.half_width) for line in (road.centre_line, road.centre_line[::-1])]
    )
    outside = distance_to_road(edge, road.centre_line) >= road.half_width * (1 - 1e-6)
    return np.concatenate([edge[outside], edge[outside][:1]])


def circle(x: float, y: float, radius: float) -> NDArray[np.float64]:
    """A closed circle (49, 2)."""
    turn = np.linspace(0, 2 * np.pi, 49)
    return np.stack([x + radius * np.cos(turn), y + radius * np.sin(turn)], -1)


def _left_of(line: NDArray, offset: float) -> NDArray[np.float64]:
    """The points to the left of `line`, with a half circle around its last point and every
    corner that bends to the right; points inside the road are not removed."""
    parts = []
    directions = np.diff(line, axis=0)
    angles = np.arctan2(directions[:, 1], directions[:, 0])
    for i, angle in enumerate(angles):
        normal = offset * np.array([-np.sin(angle), np.cos(angle)])
        share = np.linspace(0, 1, OUTLINE_POINTS)[:, None]
        parts.append(line[i] + share * directions[i] + normal)
        following = angles[i + 1] if i + 1 < len(angles) else angle - np.pi
        bend = (following - angle + np.pi) % (2 * np.pi) - np.pi
        bend = -np.pi if i + 1 == len(angles) else bend
        if bend < 0:
            turn = angle + np.pi / 2 + np.linspace(0, bend, OUTLINE_POINTS)
            parts.append(line[i + 1] + offset * np.stack([np.cos(turn), np.sin(turn)], -1))
    return np.concatenate(parts)
