"""Weight profiles: the mean weight of each of 100 equal parts of the buffer, oldest first."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class Profiles:
    """The profiles of F model fits; a bin without a transition is NaN."""

    env_step: NDArray[np.int64]  # (F,)
    bins: NDArray[np.float64]  # (F, bins)
    count: NDArray[np.int64]  # (F,) transitions in the buffer
    ess: NDArray[np.float64]  # (F,) effective sample size as a share of the buffer
    zeros: NDArray[np.float64]  # (F,) share of transitions with weight zero


def profile(weight: NDArray, bins: int) -> NDArray[np.float64]:
    """Mean weight of each of `bins` equal parts of the buffer: (N,) -> (bins,).

    Part b holds rows floor(b N / bins) to floor((b + 1) N / bins); an empty part is NaN.
    """
    weight = np.asarray(weight, np.float64)
    edges = np.arange(bins + 1) * len(weight) // bins
    total = np.concatenate([[0.0], np.cumsum(weight)])
    size = np.diff(edges)
    return np.divide(np.diff(total[edges]), size, out=np.full(bins, np.nan), where=size > 0)


def effective_share(weight: NDArray) -> float:
    """Effective sample size (sum w)^2 / sum w^2 as a share of the buffer; 0 without weight."""
    weight = np.asarray(weight, np.float64)
    square = float(np.square(weight).sum())
    return float(weight.sum()) ** 2 / square / len(weight) if square > 0 else 0.0


def zero_share(weight: NDArray) -> float:
    """Share of transitions with weight zero."""
    return float(np.mean(np.asarray(weight) == 0)) if len(weight) else 0.0
