"""Weights by age of rows: those of every fit with the returns, in columns, and profiles."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray

from app import text
from app.figures.base import (
    LAYOUT,
    band,
    horizontal_line,
    line,
    note,
    octaves,
    panels,
    relative_scale,
    step_axis_title,
    styled,
    vertical_line,
)
from app.figures.curves import return_line
from app.theme import Mode, learner_colour
from tom.analysis.curves import Curve
from tom.learners import learner_label
from tom.record.decode import Profiles
from tom.spread import spread

FLOOR = 0.01
"""the smallest weight on a log axis, a hundredth of uniform; lower ones are drawn there"""
MAP_COLUMNS = 400
"""maximum number of fits on a map; the figure says if fits were left out"""
LONE_WIDTH = 0.05
"""width of a map's only column, as a share of its step"""
HALF_A_WORD = 26
"""pixels of half a label such as "oldest", with some room"""
AGES = {"range": [0, 100.2], "tickvals": [0, 50, 100], "ticktext": ["oldest", "middle", "newest"]}
"""the axis of positions in the buffer"""
PLACE = "position in the buffer"
AT_AGE = "at %{x:.0f} % of the buffer (0: oldest)"
WEIGHT_AT = f"{AT_AGE}<br>weight %{{customdata:.3g}}<extra></extra>"
Part = tuple[str, Curve, Profiles]
"""a column: name, curve and weight profiles of a run"""


def _heatmap(profiles: Profiles, scale: Mapping[str, Any]) -> tuple[go.Heatmap, list[str]]:
    """The weights at every fit, or at some; and that these are some, in words."""
    count = len(profiles.env_step)
    fits = spread(count, MAP_COLUMNS)
    edges, bins = profiles.env_step[fits], profiles.bins[fits].T
    if count == 1:  # else the only column would be a step wide beside the returns
        step = int(edges[0])
        half = max(LONE_WIDTH * step / 2, 0.5)
        edges = step - half, step + half
    heat = go.Heatmap(
        x=edges,
        y=bin_centres(len(bins)),
        z=octaves(bins),
        customdata=bins,
        hovertemplate="step %{x:,}<br>at %{y:.0f} % of the buffer (0: oldest)<br>"
        "weight %{customdata:.3g}<extra></extra>",
        **scale,
    )
    return heat, [f"{len(fits)} of {count} fits"] if len(fits) < count else []


def weight_profile(
    bins: NDArray[np.float64], learner: str, height: int, *, top: float = 1.0, keep: str = ""
) -> go.Figure:
    """The weight of each part of the buffer at one fit, oldest to newest: bins (100,).

    The axis is that of `on_log_axis`. A zoom lasts while `keep`, the run's id, is the same, here
    and below.
    """
    figure = go.Figure(
        go.Bar(
            x=bin_centres(len(bins)),
            y=bins,
            width=100 / len(bins),
            marker={"color": learner_colour(learner), "line": {"width": 0}},
            name=text.plotly(learner_label(learner)),
            hovertemplate=WEIGHT_AT,
        )
    )
    # Plotly leaves out a label that does not fit: "oldest", left of an axis with short labels.
    more = {"margin": {"l": HALF_A_WORD}, "showlegend": False, "bargap": 0}
    marks, kept = [horizontal_line(1, 1.5, "dash")], f"profile {keep}"
    styled(figure, PLACE, height, keep=kept, marks=marks, x_axis=AGES, **more)
    return on_log_axis(figure, top)


def on_log_axis(figure: go.Figure, top: float = 1.0) -> go.Figure:
    """Put weights on a log axis that begins at FLOOR; smaller weights and zero are drawn there.

    It ends above `top` and above every weight. The weights themselves are in `customdata`, for
    hovering and for a saved table (`app/parts/plot/plot.js`, which finds FLOOR in `meta`).
    """
    traces: list[Any] = list(figure.data)
    for trace in traces:
        weights = np.asarray(trace.y, np.float64)
        trace.update(y=np.maximum(weights, FLOOR), customdata=weights)
    top = max([top, *(float(np.max(trace.y)) for trace in traces)])
    return figure.update_layout(meta={"floor": FLOOR}).update_yaxes(
        type="log",
        rangemode="normal",
        range=[np.log10(FLOOR) - 0.1, np.log10(max(top, 1.0)) + 0.15],
        tickvals=[FLOOR, 0.1, 1, 10, 100, 1000],
        ticktext=[f"≤ {FLOOR:g}", "0.1", "1", "10", "100", "1,000"],
    )


def median_profiles(
    profiles: Mapping[str, NDArray[np.float64]], random: float, height: int, *, keep: str = ""
) -> go.Figure:
    """The median profile over seeds of each learner (S, bins), with the range of its seeds.

    `random` is the share of the buffer, starting with the oldest row, that is random data. A zoom
    lasts while `keep`, the weighing's name, is the same.
    """
    figure = go.Figure()
    for learner, values in profiles.items():
        x, median = bin_centres(values.shape[1]), np.median(values, 0)
        name, colour = text.plotly(learner_label(learner)), learner_colour(learner)
        if len(values) > 1:
            figure.add_trace(band(x, values.min(0), values.max(0), colour, name, opacity=0.15))
        seeds = f"{len(values)} seed{'s' * (len(values) > 1)}"
        more: dict[str, Any] = {"name": f"{name} ({seeds})", "meta": text.plotly(learner)}
        more |= {"legendgroup": name, "shape": "hvh"}
        figure.add_trace(line(x, median, colour, 2, f"{name}<br>{WEIGHT_AT}", **more))
    marks = [horizontal_line(1, 1.5, "dash")] + [vertical_line(100 * random, 1, "dot")] * (
        random > 0
    )
    kept, y = f"probe {keep}", "mean weight"
    styled(figure, PLACE, height, keep=kept, marks=marks, y=y, x_axis=AGES)
    return on_log_axis(figure)


def bin_centres(bins: int) -> NDArray[np.float64]:
    """The centres (bins,) of equal parts of the buffer, in % of its age from oldest to newest."""
    return (np.arange(bins) + 0.5) * 100 / bins


def over_fits(parts: Sequence[Part], mode: Mode, height: int) -> go.Figure:
    """The weights of every fit above and the return below, for each (name, curve, profiles).

    Weights are the mean of each part of the buffer, newest on top; colours show log2 of them, with
    uniform in the middle. The axes of all columns are linked. Long curves and many fits are
    thinned, and the figure says so.
    """
    envs, titles = [curve.env for _, curve, _ in parts], [text.plotly(name) for name, *_ in parts]
    kept = " ".join(["over fits", *(curve.run_id for _, curve, _ in parts)])
    apart = {"horizontal_spacing": 0.02, "vertical_spacing": 0.06, "row_heights": [0.7, 0.3]}
    # Of three columns in a narrow window none is wider than a word.
    above = [name.replace(" ", "<br>") if len(parts) > 2 else name for name in titles]
    figure = panels(2, len(parts), height, kept, column_titles=above, **apart)
    every = [profiles.bins.ravel() for *_, profiles in parts if len(profiles.bins)]
    scale = relative_scale(np.concatenate(every or [np.ones(1)]), mode)
    scale["colorbar"] |= {"len": 0.68, "y": 1, "yanchor": "top"}
    last = max((i for i, (*_, of) in enumerate(parts, 1) if len(of.env_step)), default=0)
    words, some = list[str](), list[str]()
    for column, (title, (_, curve, profiles)) in enumerate(zip(titles, parts, strict=True), 1):
        if len(profiles.env_step):
            heat, thinned = _heatmap(profiles, scale | {"showscale": column == last})
            figure.add_trace(heat.update(name=f"{title} weight".strip()), 1, column)
            some += [f"{title}: {fits}".removeprefix(": ") for fits in thinned]
        else:
            # Without a trace Plotly makes no axes there, and draws the words on the first ones.
            figure.add_trace(go.Scatter(x=[None], y=[None], showlegend=False), 1, column)
            middle = {"x": 0.5, "y": 0.5, "showarrow": False, "opacity": 0.75}
            place = {f"{of}ref": f"{of}{'' if column == 1 else column} domain" for of in "xy"}
            figure.add_annotation(text="no weights recorded", **place, **middle)
        returns, thinned = return_line(curve, name=f"{title} return".strip())
        figure.add_trace(returns, 2, column)
        words = thinned or words
    lines = max(name.count("<br>") for name in above)
    figure.update_layout(margin={"t": 34 + 18 * lines if any(above) else LAYOUT["margin"]["t"]})
    figure.update_xaxes(matches="x").update_xaxes(title_text=step_axis_title(envs), row=2)
    figure.update_xaxes(ticks="", showticklabels=False, row=1)
    for row, first in ((1, "y"), (2, f"y{len(parts) + 1}")):
        figure.update_yaxes(matches=first, showticklabels=False, row=row)
        figure.update_yaxes(showticklabels=True, row=row, col=1)
    figure.update_yaxes(**AGES, ticks="", row=1)  # else Plotly draws ticks without labels at a map
    # Plotly finds no range by itself for linked axes beside others that are linked and have one.
    figure.update_yaxes(autorange=True, row=2).update_yaxes(title_text="return", row=2, col=1)
    return note(figure, words + some)
