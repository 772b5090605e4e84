"""Do weights follow the policy? Statistics of a weight profile over an ordered buffer.

The first part of the buffer is random data, the second part comes from a policy while it learns, in
order (paper, section 5.2, "Analysis of TOM Importance Weights"). Pure functions of weights.
"""

from collections.abc import Mapping, Sequence
from statistics import median
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from tom.data.sampling import bin_means, ess, zero_share

BINS = 20
DECILES = 10
LATE = 2  # number of last deciles, and of last bins, that count as the end


def progression(weights: NDArray, ordered_from: int) -> dict[str, Any]:
    """One learner's weights (N,), oldest first, whose first `ordered_from` rows are random data.

    Every mean is in units of the mean weight: `random_mean` (None without random data); `deciles`
    of the ordered part; `last_two` of 20 bins of the whole buffer. `spearman` is the rank
    correlation of the deciles with their order, `first_rise` the first decile (1 to 10) above 1
    (None without one), which `rises_before_end` if it is an early one; `ess` and `zeros` are shares
    of the buffer. Raises ValueError if all rows are random.
    """
    if not 0 <= ordered_from < len(weights):
        raise ValueError(f"no ordered rows from {ordered_from} on among {len(weights)}")
    w = np.asarray(weights, np.float64)
    w = w / w.mean() if w.mean() > 0 else w
    deciles = bin_means(w[ordered_from:], DECILES).numpy()
    above = np.flatnonzero(deciles > 1)
    return {
        "random_mean": float(w[:ordered_from].mean()) if ordered_from else None,
        "deciles": tuple(float(d) for d in deciles),
        "last_two": float(bin_means(w, BINS)[-LATE:].mean()),
        "spearman": rank_correlation(np.arange(DECILES), deciles),
        "first_rise": int(above[0]) + 1 if len(above) else None,
        "ess": ess(w),
        "zeros": zero_share(w),
        "rises_before_end": bool(len(above) and above[0] < DECILES - LATE),
    }


def rank_correlation(x: NDArray, y: NDArray) -> float:
    """Spearman's rank correlation of x and y (n,), ties ranked alike; 0 if one is constant."""
    # Bins that differ only by rounding are ties; those of tiny weights are not.
    digits = [[float(f"{value:.9g}") for value in values] for values in (x, y)]
    ranks = [pd.Series(values).rank().to_numpy() for values in digits]
    if min(np.ptp(r) for r in ranks) == 0:
        return 0.0
    return float(np.corrcoef(ranks[0], ranks[1])[0, 1])


def same_profile(weights: NDArray, others: NDArray) -> float:
    """Rank correlation of two weightings of the same rows (N,) over 20 bins."""
    return rank_correlation(bin_means(weights, BINS).numpy(), bin_means(others, BINS).numpy())


def medians(reports: Sequence[Mapping[str, Any]]) -> dict[str, float | None]:
    """Medians over seeds of the numbers in the acceptance test."""
    names = ("random_mean", "last_two", "spearman", "ess", "zeros")
    columns = {name: [report[name] for report in reports] for name in names}
    return {name: None if None in values else median(values) for name, values in columns.items()}
