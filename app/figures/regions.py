"""The map of a replay buffer, what sets a region apart, and weights against other quantities."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go

from app import text
from app.data.buffer import Against
from app.data.regions import Floats, Plane, spread
from app.figures.base import across, note, styled, upright
from app.figures.scales import octaves, relative_scale
from app.theme import COLUMNS, NEUTRAL, TEXT, Mode, learner_colour

POINTS = 8000
"""transitions that a map shows at most; what is left out is said on the figure"""
BARS = 8


def region_map(
    plane: Plane,
    weight: Floats,
    outline: Sequence[tuple[float, float]],
    mode: Mode,
    height: int,
    keep: str,
) -> go.Figure:
    """Every transition (N,) as a point, coloured by its weight; the heaviest lie on top."""
    shown = spread(len(weight), POINTS)
    shown = shown[np.argsort(weight[shown], kind="stable")]
    scale = relative_scale(weight, mode)
    figure = go.Figure(
        go.Scattergl(
            x=plane.x[shown],
            y=plane.y[shown],
            customdata=np.stack([weight[shown], shown], -1),
            mode="markers",
            marker={
                "size": 5,
                "color": octaves(weight[shown]),
                "cmin": scale["zmin"],
                "cmax": scale["zmax"],
                "colorscale": COLUMNS[mode],  # points, unlike areas, must stand out at every weight
                "colorbar": scale["colorbar"],
                "line": {"width": 0},
            },
            unselected={"marker": {"opacity": 0.35}},
            name="transitions",
            hovertemplate="transition %{customdata[1]:,} of the buffer<br>"
            "weight %{customdata[0]:.3g}<extra></extra>",
        )
    )
    marks = [_drawn(outline, TEXT[mode])] if outline else []
    styled(figure, text.plotly(plane.x_name), height, keep=keep, marks=marks)
    figure.update_layout(dragmode="lasso", showlegend=False, margin={"r": 4})
    figure.update_yaxes(title_text=text.plotly(plane.y_name))
    if len(shown) < len(weight):
        note(figure, f"{len(shown):,} of {len(weight):,} transitions, drawn evenly")
    return figure


def _drawn(outline: Sequence[tuple[float, float]], colour: str) -> dict[str, Any]:
    """The lasso or box that a reader has drawn."""
    path = "M" + "L".join(f"{x},{y}" for x, y in outline) + "Z"
    return {"type": "path", "path": path, "line": {"color": colour, "width": 1.5}}


def apart_bars(gaps: Sequence[tuple[str, float]], height: int) -> go.Figure:
    """The dimensions in which a region differs most from the buffer, the farthest on top."""
    top = list(gaps[:BARS])[::-1]
    figure = go.Figure(
        go.Bar(
            x=[gap for _, gap in top],
            y=[text.plotly(name) for name, _ in top],
            orientation="h",
            marker={"color": NEUTRAL},
            hovertemplate="%{y}<br>%{x:+.2f} standard deviations<extra></extra>",
        )
    )
    words = "standard deviations from the buffer's mean"
    return styled(figure, words, height, keep="apart", marks=[upright(0, 1)])


def weights_against(found: Against, learner: str, x: str, height: int) -> go.Figure:
    """Mean weight of equal groups of transitions, and below what nine of ten of them are."""
    colour = learner_colour(learner)
    figure = go.Figure()
    for values, name, width, dash in (
        (found.mean, "mean weight", 2.0, "solid"),
        (found.high, "9 of 10 are below", 1.2, "dot"),
    ):
        figure.add_trace(
            go.Scatter(
                x=found.x,
                y=values,
                name=name,
                mode="lines+markers" if name == "mean weight" else "lines",
                line={"color": colour, "width": width, "dash": dash},
                marker={"size": 4},
                hovertemplate=f"{text.plotly(x)} %{{x:.4g}}<br>{name} %{{y:.3g}}<extra></extra>",
            )
        )
    marks = [across(1, 1.2, "dash")]
    styled(figure, text.plotly(x), height, keep=f"against {x}", marks=marks)
    figure.update_layout(showlegend=False)
    figure.update_yaxes(rangemode="tozero", title_text="weight")
    return figure
