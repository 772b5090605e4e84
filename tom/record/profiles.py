"""Weight profiles: the mean weight of equal parts of the buffer, oldest first, at every fit."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Profiles:
    """The profiles of F model fits (`tom.data.sampling.bin_means`).

    Runs recorded until 2026-11-22 have whole rows in a bin, and NaN in one without any.
    """

    env_step: NDArray[np.int64]  # (F,)
    bins: NDArray[np.float64]  # (F, bins)
    count: NDArray[np.int64]  # (F,) transitions in the buffer
    ess: NDArray[np.float64]  # (F,) effective sample size as a share of the buffer
    zeros: NDArray[np.float64]  # (F,) share of transitions with weight zero


def zero_share(weight: NDArray) -> float:
    """Share of transitions with weight zero."""
    return float(np.mean(np.asarray(weight) == 0)) if len(weight) else 0.0
