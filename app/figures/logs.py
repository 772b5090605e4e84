"""Log axes cannot show values at or below zero: figures count these and cut their bands."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import plotly.graph_objects as go
from numpy.typing import NDArray


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
