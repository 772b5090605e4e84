"""Weights by age of rows: the step x bin map, the profile at a step, and the effective sample."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray

from app import text
from app.figures.base import ENV_STEPS, Y_AXIS, across, dashes, note, styled, upright
from app.figures.scales import linear_scale, octaves, relative_scale
from app.theme import Mode, learner_colour, learner_label
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
