"""The road-and-rocks map: weights, trajectories, real and modelled displacements."""

from collections.abc import Sequence

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray

from app import text
from app.data.road import CENTRES, Picture, circle, outline
from app.figures.base import OCTAVES, line, octaves, relative_scale, styled
from app.theme import NEUTRAL, TEXT, Mode, learner_colour
from tom.learners import learner_label

NO_DATA: dict[Mode, str] = {"light": "#c4c9d3", "dark": "#414858"}
"""the colour of cells without transitions, which is not on the scale"""
GOAL = "#1f9d55"
START = "#2b6fe0"
ARROW_STRIDE = 2
"""only every second point of the displacement field is drawn, in both directions"""


def cells(picture: Picture) -> dict[str, list[list[float | None]]]:
    """The properties of the map's heatmap that differ between fits; None where nothing lies."""

    def rounded(grid: NDArray) -> list[list[float | None]]:  # JSON has no NaN
        return [[float(f"{v:.3g}") if np.isfinite(v) else None for v in row] for row in grid]

    return {"z": rounded(octaves(picture.grid)), "customdata": rounded(picture.grid)}


def road_map(picture: Picture, mode: Mode, height: int) -> go.Figure:
    """The map with all data of one fit; the legend shows and hides layers."""
    colour = learner_colour(picture.learner)
    figure = go.Figure(
        go.Heatmap(
            x=CENTRES,
            y=CENTRES,
            z=octaves(picture.grid),
            customdata=picture.grid,
            hovertemplate="(%{x:.2f}, %{y:.2f})<br>weight %{customdata:.3g}<extra></extra>",
            name="weights",
            # The range of the columns in 3D: one scale for all runs and fits.
            **relative_scale(picture.grid, mode, flat=True, reach=OCTAVES),
        )
    )
    figure.add_trace(_lines([outline(picture.road)], "road", TEXT[mode], 1.5))
    for (x, y, radius), tint in ((picture.road.start, START), (picture.road.goal, GOAL)):
        figure.add_trace(_lines([circle(x, y, radius)], "", tint, 3))
    figure.add_trace(_lines(picture.expert, "expert", NEUTRAL, 1, opacity=0.6))
    name = f"{text.plotly(learner_label(picture.learner))} policy"
    figure.add_trace(_lines(picture.learnt, name, colour, 2.2))
    side = round(len(picture.points) ** 0.5)
    field = np.arange(side**2).reshape(side, side)[::ARROW_STRIDE, ::ARROW_STRIDE].ravel()
    for moves, label, tint in (
        (picture.true, "real move", TEXT[mode]),
        (picture.modelled, "modelled move", colour),
    ):
        points, moves = picture.points[field], moves[field]
        tips, across = points + moves, np.stack([-moves[:, 1], moves[:, 0]], -1)
        left, right = tips - 0.3 * moves + 0.18 * across, tips - 0.3 * moves - 0.18 * across
        # Shaft, then the two sides of the head.
        trace = _lines(list(np.stack([points, tips, left, tips, right], 1)), label, tint, 1.4)
        figure.add_trace(trace.update(visible="legendonly"))
    square = {"range": [0, 1], "showgrid": False, "showticklabels": False, "ticks": ""}
    square |= {"constrain": "domain"}
    return styled(
        figure,
        "",
        height,
        keep="road map",
        x_axis=square,
        y_axis={**square, "scaleanchor": "x", "constraintoward": "top"},
        plot_bgcolor=NO_DATA[mode],
        margin={"r": 4},
    )


def _lines(
    lines: Sequence[NDArray], name: str, colour: str, width: float, opacity: float = 1.0
) -> go.Scatter:
    """Several polylines as one trace, so that the legend has one entry."""
    gap = np.full((1, 2), np.nan)
    points = np.concatenate([part for each in lines for part in (each, gap)] or [gap])
    shown = bool(name) and len(lines) > 0
    more = {"name": name, "opacity": opacity, "hoverinfo": "skip", "showlegend": shown}
    return line(points[:, 0], points[:, 1], colour, width, None, **more)
