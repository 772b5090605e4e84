"""The one selection of rows that all panels of Attention's buffer share, and that its address has.

A row is chosen if it lies in every interval and inside the outline. An interval's words are
`name low..high`, either end may be open; an outline's are `plane x,y;x,y;...`, where the plane is
named by its key (`app.data.buffer_map`), so that it holds on any other plane as well.
"""

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Self

import numpy as np
from numpy.typing import NDArray

from app.data.buffer import Floats
from app.data.columns import Codes, Column, bounds

Mask = NDArray[np.bool_]
Interval = tuple[float | None, float | None]
CORNERS = 60
"""maximum number of corners of an outline"""


@dataclass(frozen=True)
class Outline:
    """Corners (x, y) on a plane."""

    plane: str
    corners: tuple[tuple[float, float], ...]


@dataclass(frozen=True)
class Selection:
    """Intervals by the name of their quantity, and an outline."""

    intervals: Mapping[str, Interval] = field(default_factory=dict)
    outline: Outline | None = None

    @classmethod
    def of(cls, where: Sequence[str], outline: Sequence[str]) -> Self:
        """From the words of an address; those that are malformed count as not there."""
        intervals = {}
        for words in where:
            name, _, span = words.rpartition(" ")
            with suppress(ValueError):
                low, high = (float(end) if end else None for end in span.split(".."))
                if name and not any(end is not None and math.isnan(end) for end in (low, high)):
                    intervals[name] = low, high
        return cls(intervals, _outline("".join(outline[-1:])))


def _outline(text: str) -> Outline | None:
    plane, _, pairs = text.rpartition(" ")
    try:
        corners = tuple((float(x), float(y)) for x, y in (p.split(",") for p in pairs.split(";")))
    except ValueError:
        return None
    whole = plane and 3 <= len(corners) <= CORNERS and np.isfinite(corners).all()
    return Outline(plane, corners) if whole else None


def between(codes: Codes, column: Column, interval: Interval) -> Mask:
    """A mask (N,) of the codes of a quantity in an interval."""
    first, last = bounds(column, *interval)
    return (codes >= first) & (codes <= last)


def inside(corners: Sequence[tuple[float, float]], x: Floats, y: Floats) -> Mask:
    """A mask (N,) of the points inside a closed outline of corners (x, y), by the even-odd rule."""
    mask = np.zeros(len(x), bool)
    ends = np.asarray(corners, np.float64).reshape(-1, 2)
    for (x0, y0), (x1, y1) in zip(ends, np.roll(ends, -1, 0), strict=True):
        crosses = (y0 > y) != (y1 > y)
        if y1 != y0:
            mask ^= crosses & (x < x0 + (y - y0) / (y1 - y0) * (x1 - x0))
    return mask
