"""Runs side by side in columns with linked axes."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go
from plotly.subplots import make_subplots

from app import text
from app.figures.base import LAYOUT, X_AXIS, Y_AXIS, note, steps_in_words
from app.figures.curves import POINTS
from app.figures.lines import decimate
from app.figures.scales import octaves, relative_scale
from app.figures.weights import AGES, bin_centres, lone, shown_fits
from app.theme import Mode, learner_colour, learner_symbol
from tom.analysis.curves import Curve
from tom.record.decode import Profiles

Part = tuple[str, Curve, Profiles]
"""a column: name, curve and weight profiles of a run"""


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
