"""Colours of numbers outside Plotly, with the scales of the figures."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Scale = Sequence[tuple[float, str]]


def rgb(colour: str) -> tuple[int, int, int]:
    """`#rrggbb` as three numbers from 0 to 255."""
    return int(colour[1:3], 16), int(colour[3:5], 16), int(colour[5:7], 16)


def on_scale(share: NDArray[np.float64], scale: Scale) -> NDArray[np.uint8]:
    """Positions in [0, 1] as colours: (...,) -> (..., 3), linear between the scale's stops."""
    stops = np.array([at for at, _ in scale])
    colours = np.array([rgb(colour) for _, colour in scale], np.float64)
    channels = [np.interp(share, stops, colours[:, c]) for c in range(3)]
    return np.stack(channels, -1).round().astype(np.uint8)


def linear(colours: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """sRGB colours as light intensities, both 0 to 255 (IEC 61966-2-1)."""
    share = np.asarray(colours, np.float64) / 255
    light = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    return (255 * light).round().astype(np.uint8)
