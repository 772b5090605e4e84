"""Do weights follow the policy? Statistics of a weight profile over an ordered buffer.

The first part of the buffer is random data, the second part comes from a policy while it learns, in
order (paper, section 5.2, "Analysis of TOM Importance Weights"). Pure functions of weights.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from statistics import median
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from tom.data.sampling import bin_means, ess, zero_share

BINS = 20
DECILES = 10
LATE = 2  # number of last deciles, and of last bins, that count as the end


@dataclass(frozen=True)
class Progression:
    """One learner's weights along one ordered buffer; every mean in units of the mean weight.

    `random_mean` is None if the buffer has no random part. `first_rise` is the first decile (1 to
    10) of the ordered part whose mean weight is above 1, None if there is none.
    """

    random_mean: float | None
    deciles: tuple[float, ...]  # mean weight of each tenth of the ordered part
    last_two: float  # mean weight of the last two of 20 bins of the whole buffer
    spearman: float  # rank correlation of the deciles with their order
    first_rise: int | None
    ess: float  # share of the buffer
    zeros: float  # share of the buffer

    @property
    def rises_before_end(self) -> bool:
        """Whether the first decile with a mean weight above 1 is an early one."""
        return self.first_rise is not None and self.first_rise <= DECILES - LATE

    def row(self) -> dict[str, Any]:
        """Every number, for a table or JSON."""
        return {**asdict(self), "rises_before_end": self.rises_before_end}


def progression(weights: NDArray, ordered_from: int) -> Progression:
    """Summary of weights (N,), oldest first, whose first `ordered_from` rows are random data.

    Raises ValueError if all of them are.
    """
    if not 0 <= ordered_from < len(weights):
        raise ValueError(f"no ordered rows from {ordered_from} on among {len(weights)}")
    w = np.asarray(weights, np.float64)
    w = w / w.mean() if w.mean() > 0 else w
    deciles = bin_means(w[ordered_from:], DECILES).numpy()
    above = np.flatnonzero(deciles > 1)
    return Progression(
        random_mean=float(w[:ordered_from].mean()) if ordered_from else None,
        deciles=tuple(float(d) for d in deciles),
        last_two=float(bin_means(w, BINS)[-LATE:].mean()),
        spearman=rank_correlation(np.arange(DECILES), deciles),
        first_rise=int(above[0]) + 1 if len(above) else None,
        ess=ess(w),
        zeros=zero_share(w),
    )


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


def medians(reports: Sequence[Progression]) -> dict[str, float | None]:
    """Medians over seeds of the numbers in the acceptance test."""
    names = ("random_mean", "last_two", "spearman", "ess", "zeros")
    columns = {name: [getattr(report, name) for report in reports] for name in names}
    return {name: None if None in values else median(values) for name, values in columns.items()}
