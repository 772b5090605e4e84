"""The map of road-and-rocks, with the task or with the weights, as figures and as rows."""

from collections.abc import Iterator, Sequence

import numpy as np
import torch
from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.colors import ListedColormap, LogNorm
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from numpy.typing import NDArray

from tom.reports.colours import NEUTRAL, TEXT
from tom.reports.style import STYLE, new_figure
from tom.road import task
from tom.road.task import RoadMap
from tom.studies.road import Story
from tom.studies.road_figure import LEARNERS

Array = NDArray[np.float64]
CELLS = 25  # along each side
EDGES = np.linspace(0, 1, CELLS + 1)
CENTRES = (EDGES[1:] + EDGES[:-1]) / 2
ROCKS, ROAD = "#f0ddd6", "#d9e6d6"
LEAST, MOST = 0.02, 50.0  # weights beyond these have the same colour


def environment_figure(road_map: RoadMap) -> Figure:
    """Road, rocks, start and goal; an arrow shows the effect of the action "right" at its place."""
    places, on_road, moved = _under_right(road_map)
    with rc_context({**STYLE, "axes.grid": False}):
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


def environment_rows(road_map: RoadMap) -> Iterator[dict[str, object]]:
    """The drawn data: each arrow's position, its ground, and the displacement in full steps."""
    for (x, y), on_road, (dx, dy) in zip(*_under_right(road_map), strict=True):
        yield {"x": x, "y": y, "road": bool(on_road), "dx": dx, "dy": dy}


def weight_figure(stories: Sequence[Story]) -> Figure:
    """Mean weight in each cell of the map, for the first seed of each learner."""
    chosen = _first_seeds(stories)
    with rc_context({**STYLE, "axes.grid": False}):
        figure = new_figure(3.1 * len(chosen) + 0.6, 3.3)
        axes = figure.subplots(1, len(chosen), squeeze=False)[0]
        images = [_draw(ax, story) for ax, (_, story) in zip(axes, chosen, strict=True)]
        for ax, (label, story) in zip(axes, chosen, strict=True):
            ax.set_title(f"{label}, seed {story.outcome.seed}")
        figure.colorbar(images[0], ax=list(axes), label="mean weight", shrink=0.8)
    return figure


def weight_rows(stories: Sequence[Story]) -> Iterator[dict[str, object]]:
    """The drawn data: one row per learner and cell with transitions."""
    for label, story in _first_seeds(stories):
        mean, count = _cells(story)
        for i, j in zip(*np.nonzero(count), strict=True):
            yield {
                "learner": label,
                "seed": story.outcome.seed,
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


def _first_seeds(stories: Sequence[Story]) -> list[tuple[str, Story]]:
    """The first story with weights of each learner, with the learner's label."""
    with_weights = [story for story in stories if story.weights is not None]
    return [
        (label, next(s for s in with_weights if s.outcome.name == name))
        for name, (_, label) in LEARNERS.items()
        if any(s.outcome.name == name for s in with_weights)
    ]


def _cells(story: Story) -> tuple[Array, Array]:
    """Mean weight (NaN for empty cells) and number of transitions; (x, y), (C, C) each."""
    assert story.places is not None
    x, y = story.places.T
    total = np.histogram2d(x, y, [EDGES, EDGES], weights=story.weights)[0]
    count = np.histogram2d(x, y, [EDGES, EDGES])[0]
    mean = np.divide(total, count, out=np.full_like(total, np.nan), where=count > 0)
    return mean, count


def _draw(ax: Axes, story: Story) -> QuadMesh:
    shown = np.clip(_cells(story)[0].T, LEAST, MOST)
    image = ax.pcolormesh(EDGES, EDGES, shown, cmap="inferno", norm=LogNorm(LEAST, MOST))
    ax.plot(*np.array(task.CENTRE_LINE).T, color="white", linewidth=1, linestyle=":")
    _as_map(ax)
    return image


def _as_map(ax: Axes) -> None:
    ax.set_aspect("equal")
    ax.set_xticks([])
    ax.set_yticks([])
