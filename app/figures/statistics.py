"""Performance profiles and the probability of improvement, as figures."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
import pandas as pd
import plotly.graph_objects as go
from numpy.typing import NDArray

from app import text
from app.figures import base
from app.figures.base import band, line, styled, vertical_line
from app.figures.curves import HOLLOW, Style, core_line
from app.theme import NEUTRAL, learner_colour, with_alpha
from tom.analysis.statistics import Interval
from tom.readable import task_title
from tom.studies.frozen import LABELS, PRINTED, WAYS
from tom.studies.verdicts import Panel, Point


@dataclass(frozen=True)
class Profile:
    """Share of a group's runs above each threshold (T,), and its band (NaN for one run)."""

    style: Style
    share: NDArray[np.float64]
    low: NDArray[np.float64]
    high: NDArray[np.float64]


def _staircase(share: NDArray[np.float64]) -> NDArray[np.float64]:
    """Heights (2 T - 1,) of a line that keeps each of `share` (T,) until the next threshold."""
    return np.repeat(share, 2)[:-1]


def profiles(
    groups: Sequence[Profile], thresholds: NDArray[np.float64], score: str, height: int, keep: str
) -> go.Figure:
    """Share of runs whose score is above each threshold, one line per group; higher is better.

    A share stays what it is until the next threshold: `thresholds` are all the scores, and more. A
    zoom lasts while the score and `keep`, which names the runs, are the same.
    """
    figure, x = go.Figure(), np.repeat(thresholds, 2)[1:]
    for one in groups:
        title, colour = text.plotly(one.style.title), one.style.colour
        if np.isfinite(one.low).any():
            figure.add_trace(band(x, _staircase(one.low), _staircase(one.high), colour, title))
        hover = f"{title}: %{{y:.0%}} of the runs above %{{x:.4g}}<extra></extra>"
        stairs, width = _staircase(one.share), HOLLOW if one.style.core else 2.4
        figure.add_trace(
            line(
                x, stairs, colour, width, hover, dash=one.style.dash, name=title, legendgroup=title
            )
        )
        if one.style.core:
            figure.add_trace(core_line(x, stairs, one.style).update(legendgroup=title))
    shares = {"range": [-0.02, 1.02], "tickformat": ".0%"}
    kept = f"profile {score} {keep}"
    return styled(figure, f"{score} above", height, keep=kept, y="share of runs", y_axis=shares)


def intervals(
    points: Sequence[Point],
    colours: Sequence[str],
    axis: str,
    level: float,
    height: int,
    keep: str,
    x_axis: Mapping[str, Any] = MappingProxyType({}),
) -> go.Figure:
    """Results with their intervals, one below the other; `level` is that of no difference."""
    coloured = list(zip(points, colours, strict=True))
    lines = list(dict.fromkeys(point.line for point in points))[::-1]
    series = list(dict.fromkeys(point.series for point in points))
    figure = go.Figure()
    for i, name in enumerate(series):
        of_series = [point for point in points if point.series == name]
        colours = [colour for point, colour in coloured if point.series == name]
        value, low, high = np.array([(one.value, one.low, one.high) for one in of_series]).T
        below = ((len(series) - 1) / 2 - i) / (len(series) + 1)
        figure.add_scatter(
            x=value,
            y=[lines.index(one.line) + below for one in of_series],
            mode="markers",
            name=text.plotly(name),
            marker={"size": 9, "color": colours, "symbol": [symbol(one.way) for one in of_series],
                    "line": {"color": colours, "width": 2}},
            error_x=_error_bars(value, low, high),
            text=[
                f"{text.plotly(', '.join(filter(None, (one.line, one.series))))}: {one.value:.3g}"
                + (f" ({one.low:.3g} to {one.high:.3g})" if np.isfinite(one.low) else "")
                for one in of_series
            ],
            hovertemplate="%{text}<extra></extra>",
        )  # fmt: skip
    words = ["<br>".join(map(text.plotly, line.split("\n"))) for line in lines]
    ticks = {"tickvals": list(range(len(lines))), "ticktext": words,
             "range": [-0.6, len(lines) - 0.4], "showgrid": False, "title": ""}  # fmt: skip
    marks = [vertical_line(level, 1.2, "dash")]
    more = {"x_axis": x_axis, "y_axis": ticks, "showlegend": len(series) > 1}
    return styled(figure, axis, height, keep=keep, marks=marks, **more)


def symbol(way: str) -> str:
    """The marker of a way: half uniform weights and TOM as printed have their own."""
    if way not in WAYS:
        return "circle"
    if WAYS[way].half:
        return "diamond-wide"
    return "circle-open" if way == PRINTED else "circle" if WAYS[way].label else "x"


FEW, MORE = (0.03, 0.1, 0.3, 1, 3), (0.5, 0.7, 0.8, 0.9, 1, 1.2, 1.5, 2, 3)
"""ticks of a logarithmic axis: of a short one and of a long one"""


def two_axes(panels: Sequence[Panel], height: int, keep: str) -> go.Figure:
    """Ways of weighing by distance and error, a panel per task, both axes logarithmic."""
    figure = base.panels(1, len(panels), height, keep, shared_yaxes=True, horizontal_spacing=0.03)
    shown: set[str] = set()
    for column, panel in enumerate(panels, 1):
        name = task_title(panel.env)
        for way, distance, error in panel.ways:
            colour = learner_colour(WAYS[way].learner or "")
            label = text.plotly(LABELS.get(way, way))
            figure.add_scatter(
                x=[distance.value], y=[error.value],
                error_x=_interval_bars(distance, colour), error_y=_interval_bars(error, colour),
                mode="markers", name=label, legendgroup=way, showlegend=way not in shown,
                marker={"size": 10, "color": [colour], "symbol": [symbol(way)],
                        "line": {"color": [colour], "width": 2}},
                hovertemplate=f"{name}: {label}<br>"
                f"distance {distance}<br>error {error}<extra></extra>",
                row=1, col=column,
            )  # fmt: skip
            shown.add(way)
        figure.update_xaxes(title_text=f"<b>{name}</b><br>distance to the policy", col=column)
    level = {"color": NEUTRAL, "width": 1.2, "dash": "dash"}
    figure.add_vline(1, line=level)
    figure.add_hline(1, line=level)
    few, more = ({"tickvals": at, "ticktext": [f"{x:g}" for x in at]} for at in (FEW, MORE))
    log = {"type": "log", "tickangle": 0}
    figure.update_xaxes(log | few | {"matches": "x", "showgrid": True}).update_yaxes(log | more)
    return figure.update_yaxes(title_text="model error over uniform's", col=1)


def _interval_bars(interval: Interval, colour: str) -> dict[str, Any]:
    ends = (np.array([end]) for end in (interval.value, interval.low, interval.high))
    return _error_bars(*ends) | {"color": with_alpha(colour, 0.55), "width": 3}


def improvement(pairs: pd.DataFrame, colours: Sequence[str], height: int, keep: str) -> go.Figure:
    """P(a run of the first beats a run of the second) for each pair, with its interval and p.

    A row of `pairs` has `first`, `second`, `probability`, `low`, `high`, `p` and `p corrected` for
    their number. A zoom lasts while `keep`, which names the runs, is the same.
    """
    points = []
    for pair in pairs.to_dict("records"):
        p = f"p {pair['p']:.2g}" + f", corrected {pair['p corrected']:.2g}" * (len(pairs) > 1)
        ends = pair["probability"], pair["low"], pair["high"]
        line = f"{pair['first']} > {pair['second']}\n{p}"
        points.append(Point(line, "", *ends))
    shares = {"range": [-0.03, 1.03], "tickvals": [0, 0.2, 0.4, 0.6, 0.8, 1], "showgrid": True}
    axis, kept = "probability of improvement", f"improvement {keep}"
    return intervals(points, colours, axis, 0.5, height, kept, shares)


def _error_bars(value: NDArray, low: NDArray, high: NDArray) -> dict[str, Any]:
    """The bars of intervals; none where the ends are NaN."""
    ends = {"array": np.nan_to_num(high - value), "arrayminus": np.nan_to_num(value - low)}
    shown = bool(np.isfinite([low, high]).any())  # a bar without length has its caps
    style = {"type": "data", "symmetric": False, "color": NEUTRAL, "thickness": 1.6}
    return {**style, "visible": shown, **ends}
