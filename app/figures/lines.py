"""What a figure leaves out of long lines, and of values at or below zero on a log axis."""

from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray


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


def left_out(lines: Sequence[tuple[NDArray, NDArray]], *, log_x: bool, log_y: bool) -> list[str]:
    """In words, which points of lines, x (T,) and y (T,) each, log axes leave out; may be empty."""
    total = gone = 0
    for x, y in lines:
        total += int(np.isfinite(y).sum())
        gone += int((np.isfinite(y) & ((log_x & (x <= 0)) | (log_y & (y <= 0)))).sum())
    return [f"{gone:,} of {total:,} values at or below zero: not on a log axis"] if gone else []


def cut_bands(figure: go.Figure, *, log_x: bool, log_y: bool) -> None:
    """End the filled bands of a figure at the smallest positive value shown."""
    traces: list[Any] = list(figure.data)
    positive = [y[y > 0] for y in (np.asarray(trace.y, np.float64) for trace in traces)]
    lowest = min((float(y.min()) for y in positive if len(y)), default=np.nan)
    for band in (trace for trace in traces if trace.fill == "toself"):
        x, y = np.asarray(band.x, np.float64), np.asarray(band.y, np.float64)
        here = (x > 0) | (not log_x)
        band.update(x=x[here], y=np.where((y > 0) | (not log_y), y, lowest)[here])
