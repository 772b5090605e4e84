"""Colour scales of weights: relative to uniform weight (octaves), or linear."""

import numpy as np
from numpy.typing import NDArray

from app.theme import DIVERGING, SEQUENTIAL, Mode
from tom import readable

OCTAVES = 4.0
"""the colours range at most from 1/16 to 16 times the uniform weight"""
_BELOW = {"orientation": "h", "y": 0, "yanchor": "top", "len": 0.9, "ypad": 8}


def octaves(weight: NDArray[np.float64]) -> NDArray[np.float64]:
    """log2 of the weight relative to uniform, clipped to the colours' range; NaN stays."""
    with np.errstate(divide="ignore"):
        return np.clip(np.log2(weight), -OCTAVES, OCTAVES)


def span(weight: NDArray[np.float64]) -> float:
    """The octaves around the uniform weight that the colours must cover: 1 to OCTAVES."""
    reach = np.abs(octaves(weight[np.isfinite(weight)]))
    needed = np.ceil(np.quantile(reach, 0.98)) if len(reach) else 1.0
    return float(np.clip(needed, 1.0, OCTAVES))


def relative_scale(
    weight: NDArray[np.float64], mode: Mode, *, flat: bool = False, reach: float | None = None
) -> dict:
    """A heatmap's colours for log2 of these weights; with `flat` the colour bar is below.

    They cover these weights, or `reach` octaves if figures are to be compared. The bar marks an end
    beyond which there are weights.
    """
    reach = span(weight) if reach is None else reach
    ticks = np.arange(-reach, reach + 1, 2 if reach == OCTAVES else 1)
    words = [readable.factor(2.0**t) for t in ticks]
    if (weight < 2**-reach).any():
        words[0] = f"≤ {words[0]}"
    if (weight > 2**reach).any():
        words[-1] = f"≥ {words[-1]}"
    bar = {"tickvals": ticks, "ticktext": words, "title": {"text": "times uniform"}}
    return {
        "colorscale": DIVERGING[mode],
        "zmin": -reach,
        "zmax": reach,
        "colorbar": _bar(bar | _BELOW if flat else bar),
    }


def linear_scale(bins: NDArray[np.float64], mode: Mode) -> dict:
    """A heatmap's linear colours; the bar marks an end beyond which there are weights."""
    finite = bins[np.isfinite(bins)]
    top = max(float(np.quantile(finite, 0.995)) if len(finite) else 1.0, 1.0)
    ticks = np.linspace(0, top, 5)
    words = [readable.short(tick) for tick in ticks]
    if (finite > top).any():
        words[-1] = f"≥ {words[-1]}"
    bar = {"tickvals": ticks, "ticktext": words, "title": {"text": "weight"}}
    return {
        "colorscale": SEQUENTIAL[mode],
        "zmin": 0,
        "zmax": top,
        "colorbar": _bar(bar),
    }


def _bar(more: dict) -> dict:
    return {"thickness": 12, "outlinewidth": 0, "len": 1.0, "xpad": 6} | more
