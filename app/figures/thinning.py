"""Thinning of long lines that keeps their extremes."""

from itertools import pairwise

import numpy as np
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
