"""The names of lines at their ends, in place of a legend."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go

from app import text
from app.figures.curves import Axes, Look
from tom.analysis.curves import Group
from tom.analysis.settings import Kind

MARK, HOLLOW_MARK = "\u25a0", "\u25a1"
GAP, LETTER, ROOM = 15, 6.4, 14
"""pixels: least distance of two labels, a letter, and the room around a label"""


def label_ends(
    figure: go.Figure, groups: Sequence[Group], looks: Mapping[Kind, Look], axes: Axes
) -> go.Figure:
    """Name every group's line at the right of the figure, at the height where it ends.

    Labels that would overlap are moved apart. The figure has its height already. Where a line ends
    at or below zero on a log axis, the legend stays.
    """
    ends = [
        (float(group.mean[np.isfinite(group.mean)][-1]), looks[group.kind], group.n)
        for group in groups
    ]
    if axes.log_y and any(y <= 0 for y, _, _ in ends):
        return figure
    # The axis ends at the lowest and highest of what is drawn; so do the labels' places, in pixels.
    traces: list[Any] = list(figure.data)
    values = np.concatenate([np.asarray(t.y, np.float64) for t in traces if t.y is not None])
    values, ys = values[np.isfinite(values)], np.array([y for y, _, _ in ends])
    if axes.log_y:
        values, ys = np.log10(values[values > 0]), np.log10(ys)
    low, high = float(values.min()), float(values.max())
    span = (high - low) or 1.0
    pixels = (figure.layout.height or 300) - 60  # type: ignore[attr-defined]
    place = moved_apart((ys - low) / span * pixels, GAP)
    names = [f"{look.title} ({n})" for _, look, n in ends]
    for name, (_, look, _), at in zip(names, ends, place, strict=True):
        mark = HOLLOW_MARK if look.core else MARK
        figure.add_annotation(
            text=f'<span style="color:{look.colour}">{mark}</span> {text.plotly(name)}',
            x=1, xref="paper", xanchor="left", xshift=6,
            y=low + at / pixels * span, yref="y", yanchor="middle", showarrow=False,
            font={"size": 12},
        )  # fmt: skip
    longest = max(map(len, names))
    figure.update_layout(showlegend=False, margin={"r": round(LETTER * longest) + ROOM})
    return figure


def moved_apart(places: np.ndarray, gap: float) -> np.ndarray:
    """The places (n,), moved a little so that no two are nearer than `gap`."""
    order = np.argsort(places, kind="stable")
    moved = places[order].astype(np.float64)
    for _ in range(200):
        close = np.flatnonzero(np.diff(moved) < gap - 1e-6)
        if not len(close):
            break
        for i in close:
            lack = (gap - (moved[i + 1] - moved[i])) / 2
            moved[i], moved[i + 1] = moved[i] - lack, moved[i + 1] + lack
    result = np.empty(len(moved))
    result[order] = moved
    return result
