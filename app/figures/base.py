"""What all figures share: layout, marks, bands, thinned lines, and the colour scales of weights."""

from collections.abc import Iterable, Mapping, Sequence
from itertools import pairwise
from types import MappingProxyType
from typing import Any

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray
from plotly.subplots import make_subplots

from app.theme import DIVERGING, NEUTRAL, Mode, with_alpha
from tom import readable
from tom.envs import ROAD

ENV_STEPS = "env steps"
DASHES = ("solid", "dash", "dot", "dashdot", "longdash", "longdashdot")
"""for lines of one colour"""
GRID = "rgba(128, 138, 158, 0.22)"
LAYOUT: dict[str, Any] = {
    "margin": {"l": 4, "r": 26, "t": 14, "b": 4},
    "paper_bgcolor": "rgba(0,0,0,0)",
    "plot_bgcolor": "rgba(0,0,0,0)",
    "hovermode": "closest",
    "legend": {
        **{"orientation": "h", "yanchor": "bottom", "y": 1.0, "x": 0, "xanchor": "left"},
        "tracegroupgap": 0,  # rows of groups lie no farther apart than others
    },
    "font": {"size": 12},
}
_AXIS = {"gridcolor": GRID, "zeroline": False, "automargin": True}
X_AXIS = {"showgrid": False, "ticks": "outside", "tickcolor": GRID, **_AXIS}
Y_AXIS: dict[str, Any] = {
    "title": {"standoff": 8},
    **_AXIS,
}  # else wide tick labels overlap the title
OCTAVES = 4.0
"""the colours range at most from 1/16 to 16 times the uniform weight"""


def step_axis_title(envs: Iterable[str]) -> str:
    """The title of a step axis: on a fixed data set, steps are not environment steps."""
    shown = set(envs)
    if ROAD not in shown:
        return ENV_STEPS
    return "steps of policy optimisation" if shown == {ROAD} else "steps"


def styled(
    figure: go.Figure,
    x: str,
    height: int,
    *,
    keep: str,
    marks: Sequence[dict] = (),
    y: str | None = None,
    x_axis: Mapping[str, Any] = MappingProxyType({}),
    y_axis: Mapping[str, Any] = MappingProxyType({}),
    **layout: Any,
) -> go.Figure:
    """`figure` with the common layout; the user's zoom is kept as long as `keep` is the same.

    `keep` names what is drawn, such as a run: a zoom on one would show nothing of another.
    The page has the figure's title; `x` and `y` are those of the axes. `marks` are lines made by
    `horizontal_line` and `vertical_line`; `x_axis`, `y_axis` and `layout` are further settings of
    Plotly. Only for a figure with one pair of axes and no layout yet, because setting a whole
    layout takes a third of the time of updates.
    """
    titles = {"text": x}, {**Y_AXIS["title"], **({} if y is None else {"text": y})}
    own = {
        "height": height,
        "uirevision": keep,
        "xaxis": {**X_AXIS, "title": titles[0], **x_axis},
        "yaxis": {**Y_AXIS, "title": titles[1], **y_axis},
        "shapes": list(marks),
    }
    margin = LAYOUT["margin"] | layout.pop("margin", {})
    figure.layout = go.Layout(LAYOUT | own | {"margin": margin} | layout)
    return figure


def panels(rows: int, columns: int, height: int, keep: str, **how: Any) -> go.Figure:
    """Several axes with the common layout, `how` they share and lie (`make_subplots`).

    The user's zoom is kept as in `styled`.
    """
    figure = make_subplots(rows, columns, **how)
    figure.update_layout(LAYOUT | {"height": height, "uirevision": keep})
    return figure.update_xaxes(X_AXIS).update_yaxes(Y_AXIS)


def line(
    x: Any,
    y: Any,
    colour: str,
    width: float,
    hover: str | None,
    *,
    dash: str | None = None,
    shape: str | None = None,
    **more: Any,
) -> go.Scatter:
    """A line through points; `more` are other properties of the trace."""
    style = {"color": colour, "width": width, "dash": dash, "shape": shape}
    return go.Scatter(x=x, y=y, line=style, hovertemplate=hover, **({"mode": "lines"} | more))


def horizontal_line(y: float, width: float, dash: str | None = None) -> dict[str, Any]:
    """A horizontal line at height `y`."""
    ends = {"x0": 0, "x1": 1, "xref": "x domain", "y0": y, "y1": y, "yref": "y"}
    return {"type": "line", **ends, "line": {"color": NEUTRAL, "width": width, "dash": dash}}


def vertical_line(x: float, width: float, dash: str | None = None) -> dict[str, Any]:
    """A vertical line at `x`."""
    ends = {"x0": x, "x1": x, "xref": "x", "y0": 0, "y1": 1, "yref": "y domain"}
    return {"type": "line", **ends, "line": {"color": NEUTRAL, "width": width, "dash": dash}}


def band(
    x: NDArray, low: NDArray, high: NDArray, colour: str, group: str, opacity: float = 0.18
) -> go.Scatter:
    """The area between two lines, which appears and disappears with its group in the legend."""
    return go.Scatter(
        x=np.concatenate([x, x[::-1]]),
        y=np.concatenate([high, low[::-1]]),
        fill="toself",
        fillcolor=with_alpha(colour, opacity),
        line={"width": 0},
        mode="lines",
        hoverinfo="skip",
        legendgroup=group,
        showlegend=False,
    )


def dashes(learners: Sequence[str]) -> list[str]:
    """A dash for each of several lines, another one for each line of the same learner."""
    counts = [learners[:i].count(learner) for i, learner in enumerate(learners)]
    return [DASHES[count % len(DASHES)] for count in counts]


def note(
    figure: go.Figure, remarks: Sequence[str], right: float = 1, *, above: bool = False
) -> go.Figure:
    """Remarks in the figure's corner, one below the other; none if there are no words.

    They end at `right`, a share of the figure's width; `above` the axes they cover no line.
    """
    if remarks:
        place = {"x": right, "y": int(above), "xref": "paper", "yref": "paper"}
        corner = {"xanchor": "right", "yanchor": "bottom", "showarrow": False, "opacity": 0.75}
        figure.add_annotation(text="<br>".join(remarks), **place, **corner, font={"size": 11})
    return figure


def octaves(weight: NDArray[np.float64]) -> NDArray[np.float64]:
    """log2 of the weight relative to uniform, clipped to the colours' range; NaN stays."""
    with np.errstate(divide="ignore"):
        return np.clip(np.log2(weight), -OCTAVES, OCTAVES)


def covered_octaves(weight: NDArray[np.float64]) -> float:
    """The octaves around the uniform weight that the colours must cover: 1 to OCTAVES."""
    reach = np.abs(octaves(weight[np.isfinite(weight)]))
    needed = np.ceil(np.quantile(reach, 0.98)) if len(reach) else 1.0
    return float(np.clip(needed, 1.0, OCTAVES))


def relative_scale(
    weight: NDArray[np.float64], mode: Mode, *, flat: bool = False, reach: float | None = None
) -> dict[str, Any]:
    """A heatmap's colours for log2 of these weights; with `flat` the colour bar is below.

    They cover these weights, or `reach` octaves if figures are to be compared. The bar marks an end
    beyond which there are weights.
    """
    reach = covered_octaves(weight) if reach is None else reach
    ticks = np.arange(-reach, reach + 1, 2 if reach == OCTAVES else 1)
    words = [readable.factor(2.0**t) for t in ticks]
    if (weight < 2**-reach).any():
        words[0] = f"≤ {words[0]}"
    if (weight > 2**reach).any():
        words[-1] = f"≥ {words[-1]}"
    place = {"orientation": "h", "y": 0, "yanchor": "top", "len": 0.9, "ypad": 8} if flat else {}
    bar = {"tickvals": ticks, "ticktext": words, "title": {"text": "times uniform"}}
    bar |= {"thickness": 12, "outlinewidth": 0, "len": 1.0, "xpad": 6} | place
    return {"colorscale": DIVERGING[mode], "zmin": -reach, "zmax": reach, "colorbar": bar}


def decimate(
    step: NDArray[np.int64], value: NDArray[np.float64], limit: int
) -> tuple[NDArray[np.int64], NDArray[np.float64], bool]:
    """At most `limit` points with the extremes of every bucket; whether points were dropped."""
    if len(step) <= limit:
        return step, value, False
    edges = np.linspace(0, len(step), limit // 2 + 1).astype(int)
    keep = [
        index
        for a, b in pairwise(edges)
        for index in sorted({a + int(np.argmin(value[a:b])), a + int(np.argmax(value[a:b]))})
    ]
    return step[keep], value[keep], True


def dropped_by_log_axes(
    lines: Sequence[tuple[NDArray, NDArray]], *, log_x: bool, log_y: bool
) -> list[str]:
    """In words, which points of lines, x (T,) and y (T,) each, log axes leave out; may be empty."""
    total = dropped = 0
    for x, y in lines:
        total += int(np.isfinite(y).sum())
        dropped += int((np.isfinite(y) & ((log_x & (x <= 0)) | (log_y & (y <= 0)))).sum())
    return (
        [f"{dropped:,} of {total:,} values at or below zero: not on a log axis"] if dropped else []
    )


def cut_bands(figure: go.Figure, *, log_x: bool, log_y: bool) -> None:
    """End the filled bands of a figure at the smallest positive value shown."""
    traces: list[Any] = list(figure.data)
    positive = [y[y > 0] for y in (np.asarray(trace.y, np.float64) for trace in traces)]
    lowest = min((float(y.min()) for y in positive if len(y)), default=np.nan)
    for band in (trace for trace in traces if trace.fill == "toself"):
        x, y = np.asarray(band.x, np.float64), np.asarray(band.y, np.float64)
        here = (x > 0) | (not log_x)
        band.update(x=x[here], y=np.where((y > 0) | (not log_y), y, lowest)[here])
