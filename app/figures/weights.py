"""Weights by age of rows: the step x bin map, a profile, the effective sample, runs in columns."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray
from plotly.subplots import make_subplots

from app import text
from app.figures.base import (
    ENV_STEPS,
    LAYOUT,
    X_AXIS,
    Y_AXIS,
    across,
    dashes,
    decimate,
    linear_scale,
    note,
    octaves,
    relative_scale,
    steps_in_words,
    styled,
    upright,
)
from app.figures.curves import POINTS
from app.theme import Mode, learner_colour, learner_label, learner_symbol
from tom.analysis.curves import Curve
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
Part = tuple[str, Curve, Profiles]
"""a column: name, curve and weight profiles of a run"""


def weight_map(
    profiles: Profiles,
    chosen: int,
    mode: Mode,
    height: int,
    *,
    relative: bool,
    x: str = ENV_STEPS,
    keep: str = "",
) -> go.Figure:
    """Mean weight of each part of the buffer (newest on top) at each fit (x axis).

    With `relative` colours show log2 of the weight, with uniform in the middle; the fit with index
    `chosen` is marked. A zoom lasts while `keep`, the run's id, is the same, here and below.
    """
    fits = shown_fits(len(profiles.env_step), chosen)
    bins = profiles.bins[fits].T  # (bins, F)
    centres = bin_centres(bins.shape[0])
    steps = profiles.env_step[fits]
    figure = go.Figure(
        go.Heatmap(
            x=steps if len(steps) > 1 else lone(int(steps[0])),
            y=centres,
            z=octaves(bins) if relative else bins,
            customdata=bins,
            hovertemplate=(
                "step %{x:,}<br>at %{y:.0f} % of the buffer (0: oldest)<br>"
                "weight %{customdata:.3g}<extra></extra>"
            ),
            **(relative_scale(bins, mode) if relative else linear_scale(bins, mode)),
        )
    )
    marks = [upright(int(profiles.env_step[chosen]), 2)]
    styled(figure, x, height, keep=f"weight-map {keep}", marks=marks)
    figure.update_yaxes(**AGES)
    if len(fits) < len(profiles.env_step):
        note(figure, f"{len(fits)} of {len(profiles.env_step)} fits")
    return figure


def lone(step: int) -> tuple[float, float]:
    """The two edges of the only column, which would else be a step wide beside the returns."""
    half = max(LONE_WIDTH * step / 2, 0.5)
    return step - half, step + half


def with_returns(figure: go.Figure, curve: Curve, chosen: int) -> go.Figure:
    """A map of weights with the run's returns below it on the same axis, and with their zoom.

    The step `chosen` is marked in both.
    """
    figure.add_trace(
        go.Scatter(
            x=curve.step,
            y=curve.value,
            yaxis="y2",
            name="return",
            mode="lines+markers" if len(curve.step) < 60 else "lines",
            line={"color": learner_colour(curve.learner), "width": 1.8},
            marker={"size": 5},
            showlegend=False,
            hovertemplate="step %{x:,}<br>return %{y:,.5~g}<extra></extra>",
        )
    )
    below = {**Y_AXIS, "domain": [0, 0.24], "title": {"text": "return"}, "anchor": "x"}
    figure.update_layout(yaxis={"domain": [0.3, 1]}, yaxis2=below, xaxis={"anchor": "y2"})
    figure.update_layout(uirevision=f"weight-map and returns {curve.run_id}")
    figure.update_traces(selector={"type": "heatmap"}, colorbar={"len": 0.72, "y": 0.65})
    figure.layout.shapes = [upright(chosen, 2) | {"yref": "paper"}]  # type: ignore[attr-defined]
    return figure


def weight_profile(
    bins: NDArray[np.float64],
    learner: str,
    height: int,
    top: float | None = None,
    *,
    keep: str = "",
) -> go.Figure:
    """The weight of each part of the buffer at one fit, oldest to newest: bins (100,).

    The axis ends above `top`, the largest weight of the fits to be compared.
    """
    figure = go.Figure(
        go.Bar(
            x=bin_centres(len(bins)),
            y=bins,
            width=100 / len(bins),
            marker={"color": learner_colour(learner), "line": {"width": 0}},
            name=text.plotly(learner_label(learner)),
            hovertemplate="at %{x:.0f} % of the buffer (0: oldest)"
            "<br>weight %{y:.3g}<extra></extra>",
        )
    )
    _finish_profile(figure, height, keep)
    figure.update_layout(showlegend=False, bargap=0)
    if top is not None and np.isfinite(top):
        figure.update_yaxes(range=[0, 1.05 * max(top, 1.0)])
    return figure


def profile_lines(
    profiles: Sequence[tuple[str, str, NDArray]], height: int, *, log: bool, keep: str = ""
) -> go.Figure:
    """The last profiles of several runs as stepped lines: (name, learner, bins).

    Runs without a profile have no bins.
    """
    figure = go.Figure()
    usual = dashes([learner for _, learner, _ in profiles])
    for (name, learner, bins), dash in zip(profiles, usual, strict=True):
        if not len(bins):
            continue  # it counts, so that a run has the same dash as in other figures
        figure.add_trace(
            go.Scatter(
                x=bin_centres(len(bins)),
                y=bins,
                customdata=bins,
                name=text.plotly(name),
                mode="lines",
                line={
                    "color": learner_colour(learner),
                    "width": 1.8,
                    "shape": "hvh",
                    "dash": dash,
                },
                hovertemplate=f"{text.plotly(name)}<br>at %{{x:.0f}} % of the buffer (0: oldest)"
                "<br>weight %{customdata:.3g}<extra></extra>",
            )
        )
    _finish_profile(figure, height, keep)
    return on_log_axis(figure) if log else figure


def on_log_axis(figure: go.Figure) -> go.Figure:
    """Put weights on a log axis that ends at FLOOR; smaller weights and zero are drawn there.

    The hover numbers (`customdata`) are unchanged.
    """
    traces: list[Any] = list(figure.data)
    for trace in traces:
        trace.update(y=np.maximum(np.asarray(trace.y, np.float64), FLOOR))
    top = max((float(np.max(trace.y)) for trace in traces), default=1.0)
    figure.update_yaxes(
        type="log",
        rangemode="normal",
        range=[np.log10(FLOOR) - 0.1, np.log10(max(top, 1.0)) + 0.15],
        tickvals=[FLOOR, 0.1, 1, 10, 100, 1000],
        ticktext=[f"≤ {FLOOR:g}", "0.1", "1", "10", "100", "1,000"],
    )
    return figure


def effective_sample(
    profiles: Profiles,
    learner: str,
    chosen: int,
    height: int,
    x: str = ENV_STEPS,
    *,
    keep: str = "",
) -> go.Figure:
    """Effective sample size and share of zero weights over training, in % of the buffer."""
    figure = go.Figure()
    for values, name, dash in (
        (profiles.ess, "effective sample size", "solid"),
        (profiles.zeros, "share of zero weights", "dot"),
    ):
        figure.add_trace(
            go.Scatter(
                x=profiles.env_step,
                y=100 * values,
                name=name,
                mode="lines+markers",
                line={"color": learner_colour(learner), "width": 2, "dash": dash},
                marker={"size": 5},
                hovertemplate=f"{name}: %{{y:.1f}} %<br>step %{{x:,}}<extra></extra>",
            )
        )
    marks = [upright(int(profiles.env_step[chosen]), 2)]
    styled(figure, x, height, keep=f"effective-sample {keep}", marks=marks)
    figure.update_yaxes(range=[-3, 103], ticksuffix=" %")
    return figure


def bin_centres(bins: int) -> NDArray[np.float64]:
    """The centres (bins,) of equal parts of the buffer, in % of its age from oldest to newest."""
    return (np.arange(bins) + 0.5) * 100 / bins


def shown_fits(count: int, chosen: int) -> NDArray[np.int64]:
    """Indices of at most MAP_COLUMNS evenly spread fits, including `chosen` and both ends."""
    return np.union1d(spread(count, MAP_COLUMNS - 1), [chosen])


def _finish_profile(figure: go.Figure, height: int, keep: str) -> go.Figure:
    marks = [across(1, 1.5, "dash")]
    styled(figure, "position in the buffer", height, keep=f"profile {keep}", marks=marks)
    figure.update_xaxes(**AGES)
    # Plotly leaves out a label that does not fit: "oldest", left of an axis with short labels.
    figure.update_layout(margin={"l": HALF_A_WORD})
    figure.update_yaxes(type="linear", rangemode="tozero")
    return figure


def side_by_side(parts: Sequence[Part], mode: Mode, height: int) -> go.Figure:
    """The return above and the weights of every fit below, for each (name, curve, profiles).

    Long curves and many fits are thinned, and the figure says so.
    """
    figure = make_subplots(
        rows=2,
        cols=len(parts),
        column_titles=[text.plotly(name) for name, *_ in parts],
        horizontal_spacing=0.02,
        vertical_spacing=0.06,
    )
    bins = [profiles.bins for *_, profiles in parts if len(profiles.bins)]
    flat = np.concatenate([part.ravel() for part in bins]) if bins else np.ones(1)
    scale = relative_scale(flat, mode)
    last = max((i for i, (*_, held) in enumerate(parts, 1) if len(held.env_step)), default=0)
    for column, (_, curve, profiles) in enumerate(parts, 1):
        figure.add_trace(_line(curve), 1, column)
        if len(profiles.env_step):
            figure.add_trace(_map(profiles, scale, bar=column == last), 2, column)
        else:
            _say_empty(figure, len(parts), column)
    runs = " ".join(curve.run_id for _, curve, _ in parts)
    figure.update_layout(**LAYOUT, height=height, uirevision=f"side by side {runs}")
    figure.update_layout(margin={"t": 34})
    _link_axes(figure, len(parts), steps_in_words(curve.env for _, curve, _ in parts))
    figure.update_traces(
        selector={"type": "heatmap"},
        colorbar={"len": 0.48, "y": 0, "yanchor": "bottom"},
    )
    words = _left_out(parts)
    return note(figure, "<br>".join(words)) if words else figure


def _left_out(parts: Sequence[Part]) -> list[str]:
    """In words, what the figure leaves out."""
    thinned = any(len(curve.step) > POINTS for _, curve, _ in parts)
    words = [f"returns thinned to {POINTS} points a line"] if thinned else []
    for name, _, profiles in parts:
        fits = len(profiles.env_step)
        shown = len(shown_fits(fits, fits - 1)) if fits else 0
        if shown < fits:
            words.append(f"{text.plotly(name)}: {shown} of {fits} fits")
    return words


def _map(profiles: Profiles, scale: Mapping[str, Any], *, bar: bool) -> go.Heatmap:
    """The weights of the shown fits, with a colour bar if `bar`."""
    shown = shown_fits(len(profiles.env_step), len(profiles.env_step) - 1)
    steps, weights = profiles.env_step[shown], profiles.bins[shown].T
    return go.Heatmap(
        x=steps if len(steps) > 1 else lone(int(steps[0])),
        y=bin_centres(len(weights)),
        z=octaves(weights),
        customdata=weights,
        hovertemplate="step %{x:,}<br>at %{y:.0f} % of the buffer (0: oldest)<br>"
        "weight %{customdata:.3g}<extra></extra>",
        showscale=bar,
        **scale,
    )


def _link_axes(figure: go.Figure, columns: int, x: str) -> None:
    """Link the zoom of all columns; only the left and bottom axes have labels."""
    figure.update_xaxes(matches="x", title_text="", **X_AXIS)
    figure.update_yaxes(**Y_AXIS)
    for row, first in ((1, "y"), (2, f"y{columns + 1}")):
        figure.update_yaxes(matches=first, showticklabels=False, row=row)
        figure.update_yaxes(showticklabels=True, row=row, col=1)
    figure.update_xaxes(title_text=x, row=2)
    figure.update_xaxes(ticks="", showticklabels=False, row=1)
    figure.update_yaxes(title_text="return", row=1, col=1)
    figure.update_yaxes(
        **AGES,
        ticks="",  # else Plotly draws ticks without labels beside a map
        row=2,
    )


def _say_empty(figure: go.Figure, columns: int, column: int) -> None:
    # Without a trace Plotly makes no axes there, and draws the words on the first ones.
    figure.add_trace(go.Scatter(x=[None], y=[None], showlegend=False), 2, column)
    axis = columns + column
    figure.add_annotation(
        text="no weights recorded",
        xref=f"x{axis} domain",
        yref=f"y{axis} domain",
        x=0.5,
        y=0.5,
        showarrow=False,
        opacity=0.75,
    )


def _line(curve: Curve) -> go.Scatter:
    step, value, _ = decimate(curve.step, curve.value, POINTS)
    return go.Scatter(
        x=step,
        y=value,
        meta=curve.run_id,
        mode="lines+markers",
        line={"color": learner_colour(curve.learner), "width": 2},
        marker={"size": 5, "symbol": learner_symbol(curve.learner)},
        hovertemplate=f"{text.plotly(curve.run_id)}<br>%{{x:,}} steps: %{{y:.4g}}<extra></extra>",
        showlegend=False,
    )
