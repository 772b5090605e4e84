"""The map of a replay buffer, features of a region, and weights against other quantities."""

import textwrap
from collections.abc import Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray

from app import text
from app.data.buffer import Against, Rows
from app.data.regions import Mask, Plane
from app.figures.base import across, note, styled, upright
from app.figures.scales import octaves, relative_scale
from app.theme import COLUMNS, NEUTRAL, TEXT, Mode, learner_colour
from tom.spread import spread

POINTS = 8000
"""maximum number of transitions on a map; the figure says if some were left out"""
RINGS = 2000
"""maximum number of marked transitions of a region"""
BARS = 8
TITLE_LETTERS = 22
"""in a line of an axis title; four panels stand beside each other on a narrow window"""
HOVER = (
    "step %{customdata[0]:,}<br>episode %{customdata[1]:,}, its step %{customdata[2]:,}<br>"
    "%{customdata[3]}<br>reward %{customdata[4]:.3g}<br>weight %{customdata[5]:.3g}<extra></extra>"
)


def region_map(
    plane: Plane,
    rows: Rows,
    region: Mask,
    outline: Sequence[tuple[float, float]],
    mode: Mode,
    height: int,
    keep: str,
) -> go.Figure:
    """Every transition (N,) as a point, coloured by its weight, the heaviest on top.

    Points of the region (N,) have a ring.
    """
    weight = rows.weight
    shown = spread(len(weight), POINTS)
    shown = shown[np.argsort(weight[shown], kind="stable")]
    scale = relative_scale(weight, mode)
    marker = {
        "size": 5,
        "color": octaves(weight[shown]),
        "cmin": scale["zmin"],
        "cmax": scale["zmax"],
        "colorscale": COLUMNS[mode],  # points must be visible at every weight
        "colorbar": scale["colorbar"],
        "line": {"width": 0},
    }
    figure = go.Figure(
        go.Scattergl(
            x=plane.x[shown],
            y=plane.y[shown],
            customdata=hover_data(rows, shown),
            mode="markers",
            marker=marker,
            unselected={"marker": {"opacity": 0.35}},
            name="transitions",
            hovertemplate=HOVER,
        )
    )
    ringed = np.flatnonzero(region) if not region.all() else np.zeros(0, np.int64)
    ringed = ringed[spread(len(ringed), RINGS)]
    figure.add_trace(
        go.Scattergl(
            x=plane.x[ringed],
            y=plane.y[ringed],
            mode="markers",
            marker={"size": 8, "symbol": "circle-open", "color": TEXT[mode], "line": {"width": 1}},
            opacity=0.55,
            hoverinfo="skip",
            name="region",
        )
    )
    marks = [_drawn(outline, TEXT[mode])] if outline else []
    styled(figure, text.plotly(plane.x_name), height, keep=keep, marks=marks)
    figure.update_layout(dragmode="lasso", showlegend=False, margin={"r": 4})
    figure.update_yaxes(title_text=text.plotly(plane.y_name))
    if len(shown) < len(weight):
        note(figure, f"{len(shown):,} of {len(weight):,} transitions, drawn evenly")
    return figure


def hover_data(rows: Rows, index: NDArray[np.int64]) -> NDArray[np.object_]:
    """Hover data of rows (K,): step, episode, step in it, phase, reward, weight: (K, 6)."""
    version = rows.version[index]
    phase = np.where(version == 0, "exploration", np.char.add("policy ", version.astype(str)))
    if not rows.policies_known:
        phase = np.full(len(index), "policy not known")
    columns = (
        rows.first + index + 1,
        rows.episode[index] + 1,
        rows.place[index] + 1,
        phase,
        np.asarray(rows.rows.reward)[index],
        rows.weight[index],
    )
    return np.stack([np.asarray(column, object) for column in columns], -1)


def _drawn(outline: Sequence[tuple[float, float]], colour: str) -> dict[str, Any]:
    """The lasso or box that the user has drawn."""
    path = "M" + "L".join(f"{x},{y}" for x, y in outline) + "Z"
    return {"type": "path", "path": path, "line": {"color": colour, "width": 1.5}}


def apart_bars(gaps: Sequence[tuple[str, float]], height: int, *, keep: str = "") -> go.Figure:
    """The dimensions in which a region differs most from the buffer, the farthest on top.

    A zoom lasts while `keep`, the run's id, is the same.
    """
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
    return styled(figure, words, height, keep=f"apart {keep}", marks=[upright(0, 1)])


def weights_against(
    groups: Against, learner: str, x: str, height: int, *, keep: str = ""
) -> go.Figure:
    """Mean weight and 90 % quantile of equal groups of transitions.

    A zoom lasts while `keep`, the run's id, is the same.
    """
    colour = learner_colour(learner)
    figure = go.Figure()
    for values, name, width, dash in (
        (groups.mean, "mean weight", 2.0, "solid"),
        (groups.high, "9 of 10 are below", 1.2, "dot"),
    ):
        figure.add_trace(
            go.Scatter(
                x=groups.x,
                y=values,
                name=name,
                mode="lines+markers" if name == "mean weight" else "lines",
                line={"color": colour, "width": width, "dash": dash},
                marker={"size": 4},
                hovertemplate=f"{text.plotly(x)} %{{x:.4g}}<br>{name} %{{y:.3g}}<extra></extra>",
            )
        )
    marks = [across(1, 1.2, "dash")]
    title = "<br>".join(text.plotly(line) for line in textwrap.wrap(x, TITLE_LETTERS))
    styled(figure, title, height, keep=f"against {x} {keep}", marks=marks)
    figure.update_layout(showlegend=False)
    figure.update_yaxes(rangemode="tozero", title_text="weight")
    return figure
