"""The map of road-and-rocks, with the task or with the weights, as figures and as rows."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
import torch
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import ListedColormap, LogNorm
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from numpy.typing import NDArray

from tom.reports.figures import NEUTRAL, TEXT, new_figure
from tom.road import task
from tom.road.task import RoadMap
from tom.studies.study import Row

Array = NDArray[np.float64]
CELLS = 25  # along each side
EDGES = np.linspace(0, 1, CELLS + 1)
CENTRES = (EDGES[1:] + EDGES[:-1]) / 2
ROCKS, ROAD = "#f0ddd6", "#d9e6d6"
LEAST, MOST = 0.02, 50.0  # weights beyond these have the same colour


class Places(NamedTuple):
    """The weights of one training over the map."""

    learner: str
    seed: int
    places: NDArray[np.float32]  # (N, 2)
    weights: NDArray[np.float32]  # (N,)


def environment_figure(road_map: RoadMap) -> Figure:
    """Road, rocks, start and goal; an arrow shows the effect of the action "right" at its place."""
    places, on_road, moved = _under_right(road_map)
    figure = new_figure(3.6, 3.6)
    ax = figure.subplots()
    ground = on_road.reshape(CELLS, CELLS)
    ax.pcolormesh(EDGES, EDGES, ground, cmap=ListedColormap([ROCKS, ROAD]))
    ax.quiver(*places.T, *moved.T, color=TEXT, angles="xy", scale=CELLS, width=0.004)
    for place, radius in ((task.START, task.START_RADIUS), (task.GOAL, task.GOAL_RADIUS)):
        centre = (float(place[0]), float(place[1]))
        ax.add_patch(Circle(centre, radius, fill=False, color=NEUTRAL, linewidth=1.5))
    _as_map(ax)
    return figure


def environment_rows(road_map: RoadMap) -> Iterator[Row]:
    """The drawn data: each arrow's position, its ground, and the displacement in full steps."""
    for (x, y), on_road, (dx, dy) in zip(*_under_right(road_map), strict=True):
        yield {"x": x, "y": y, "road": bool(on_road), "dx": dx, "dy": dy}


def weight_figure(drawn: Sequence[Places]) -> Figure:
    """Mean weight in each cell of the map."""
    figure = new_figure(3.1 * len(drawn) + 0.6, 3.3)
    axes = figure.subplots(1, len(drawn), squeeze=False)[0]
    norm = LogNorm(LEAST, MOST)
    for ax, of in zip(axes, drawn, strict=True):
        shown = np.clip(_cells(of)[0].T, LEAST, MOST)
        ax.pcolormesh(EDGES, EDGES, shown, cmap="inferno", norm=norm)
        ax.plot(*np.array(task.CENTRE_LINE).T, color="white", linewidth=1, linestyle=":")
        ax.set_title(f"{of.learner}, seed {of.seed}")
        _as_map(ax)
    bar = ScalarMappable(norm, "inferno")
    figure.colorbar(bar, ax=list(axes), label="mean weight", shrink=0.8)
    return figure


def weight_rows(drawn: Sequence[Places]) -> Iterator[Row]:
    """The drawn data: one row per learner and cell with transitions."""
    for of in drawn:
        mean, count = _cells(of)
        for i, j in zip(*np.nonzero(count), strict=True):
            yield {
                "learner": of.learner,
                "seed": of.seed,
                "x": CENTRES[i],
                "y": CENTRES[j],
                "transitions": int(count[i, j]),
                "mean weight": mean[i, j],
            }


def _under_right(road_map: RoadMap) -> tuple[Array, NDArray[np.bool_], Array]:
    """Centres (C C, 2) of the map's cells, whether they are road, displacements in full steps."""
    x, y = (grid.ravel() for grid in np.meshgrid(CENTRES, CENTRES))
    places = torch.from_numpy(np.stack([x, y], 1)).float()
    right = torch.tensor([1.0, 0.0]).expand(len(places), 2)
    moved = task.displacement(road_map, places, right) / task.STEP
    return np.stack([x, y], 1), task.on_road(places).numpy(), moved.double().numpy()


def _cells(of: Places) -> tuple[Array, Array]:
    """Mean weight (NaN for empty cells) and number of transitions; (x, y), (C, C) each."""
    x, y = of.places.T
    total = np.histogram2d(x, y, [EDGES, EDGES], weights=of.weights)[0]
    count = np.histogram2d(x, y, [EDGES, EDGES])[0]
    mean = np.divide(total, count, out=np.full_like(total, np.nan), where=count > 0)
    return mean, count


def _as_map(ax: Axes) -> None:
    ax.set_aspect("equal")
    ax.grid(False)
    ax.set_xticks([])
    ax.set_yticks([])
