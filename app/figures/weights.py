"""Weights over the buffer's age: the step x bin map, the profile at a step, and what is left."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray

from app import text
from app.figures.base import DASHES, ENV_STEPS, across, note, styled, upright
from app.figures.scales import linear_scale, octaves, relative_scale
from app.theme import Mode, learner_colour, learner_label
from tom.record.profiles import Profiles

FLOOR = 0.01
"""the least weight that a log axis tells from zero: a hundredth of uniform"""
MAP_COLUMNS = 400
"""fits that a map shows at most; what is left out is said on the figure"""


def weight_map(
    profiles: Profiles,
    chosen: int,
    mode: Mode,
    height: int,
    *,
    relative: bool,
    x: str = ENV_STEPS,
) -> go.Figure:
    """Mean weight of each part of the buffer (upwards: newer) at each fit (to the right).

    `relative` colours by log2 of the weight, the uniform weight in the middle; `chosen` is the
    index of the fit that is marked.
    """
    fits = shown_fits(len(profiles.env_step), chosen)
    bins = profiles.bins[fits].T  # (bins, F)
    centres = bin_centres(bins.shape[0])
    steps = profiles.env_step[fits]
    figure = go.Figure(
        go.Heatmap(
            x=steps,
            y=centres,
            z=octaves(bins) if relative else bins,
            customdata=bins,
            hovertemplate=(
                "step %{x:,}<br>%{y:.0f} % of the buffer's age<br>"
                "weight %{customdata:.3g}<extra></extra>"
            ),
            **(relative_scale(bins, mode) if relative else linear_scale(bins, mode)),
        )
    )
    marks = [upright(int(profiles.env_step[chosen]), 2)]
    styled(figure, x, height, keep="weight-map", marks=marks)
    figure.update_yaxes(
        range=[0, 100.2], tickvals=[0, 50, 100], ticktext=["oldest", "middle", "newest"]
    )
    if len(fits) < len(profiles.env_step):
        note(figure, f"{len(fits)} of {len(profiles.env_step)} fits")
    return figure


def weight_profile(bins: NDArray[np.float64], learner: str, height: int) -> go.Figure:
    """The weight of each part of the buffer, oldest to newest, at one fit: bins (100,)."""
    figure = go.Figure(
        go.Bar(
            x=bin_centres(len(bins)),
            y=bins,
            width=100 / len(bins),
            marker={"color": learner_colour(learner), "line": {"width": 0}},
            name=text.plotly(learner_label(learner)),
            hovertemplate="%{x:.0f} % of the buffer's age<br>weight %{y:.3g}<extra></extra>",
        )
    )
    _finish_profile(figure, height)
    figure.update_layout(showlegend=False, bargap=0)
    return figure


def profile_lines(
    profiles: Sequence[tuple[str, str, NDArray]], height: int, *, log: bool
) -> go.Figure:
    """The last profiles of several runs as stepped lines: (name, learner, bins)."""
    figure = go.Figure()
    learners = [learner for _, learner, _ in profiles]
    for i, (name, learner, bins) in enumerate(profiles):
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
                    "dash": DASHES[learners[:i].count(learner) % len(DASHES)],
                },
                hovertemplate=f"{text.plotly(name)}<br>%{{x:.0f}} % of the buffer's age"
                "<br>weight %{customdata:.3g}<extra></extra>",
            )
        )
    _finish_profile(figure, height)
    return on_log_axis(figure) if log else figure


def on_log_axis(figure: go.Figure) -> go.Figure:
    """Weights on a log axis that ends at FLOOR, where all below it, zero too, is drawn.

    The numbers under the pointer (`customdata`) stay what they are.
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
    profiles: Profiles, learner: str, chosen: int, height: int, x: str = ENV_STEPS
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
    styled(figure, x, height, keep="effective-sample", marks=marks)
    figure.update_yaxes(range=[-3, 103], ticksuffix=" %")
    return figure


def bin_centres(bins: int) -> NDArray[np.float64]:
    """The middles (bins,) of equal parts of the buffer, in % of its age from oldest to newest."""
    return (np.arange(bins) + 0.5) * 100 / bins


def shown_fits(count: int, chosen: int) -> NDArray[np.int64]:
    """Indices of at most MAP_COLUMNS fits, evenly spread, `chosen` and both ends among them."""
    if count <= MAP_COLUMNS:
        return np.arange(count)
    spread = np.linspace(0, count - 1, MAP_COLUMNS - 1).astype(np.int64)
    return np.union1d(spread, [chosen])


def _finish_profile(figure: go.Figure, height: int) -> go.Figure:
    styled(figure, "position in the buffer", height, keep="profile", marks=[across(1, 1.5, "dash")])
    figure.update_xaxes(
        range=[0, 100.2], tickvals=[0, 50, 100], ticktext=["oldest", "middle", "newest"]
    )
    figure.update_yaxes(type="linear", rangemode="tozero")
    return figure
