"""Some of many things, evenly."""

import numpy as np
from numpy.typing import NDArray


def spread(count: int, most: int) -> NDArray[np.int64]:
    """At most `most` of `count` row numbers, evenly, with the first and the last, ascending."""
    return np.linspace(0, count - 1, min(count, most)).round().astype(np.int64)
