"""Weight profiles: the mean weight in equal parts of the buffer, oldest first, at every fit."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Profiles:
    """The profiles of F model fits (`tom.data.sampling.bin_means`).

    In runs recorded before 2026-11-22 bins have whole rows, and NaN if there are none.
    """

    env_step: NDArray[np.int64]  # (F,)
    bins: NDArray[np.float64]  # (F, bins)
    count: NDArray[np.int64]  # (F,) transitions in the buffer
    ess: NDArray[np.float64]  # (F,) effective sample size as a share of the buffer
    zeros: NDArray[np.float64]  # (F,) share of transitions with weight zero
