"""Which fits count where runs of a task are compared by their exams: one rule for all."""

from collections.abc import Iterable

import numpy as np
import pandas as pd

ESS = "weights/ess"


def counted_from(runs: Iterable[pd.DataFrame]) -> float:
    """The step of the fit from which on every run weighs, from the runs' metrics.

    Until a learner knows its policy, its weights are uniform (TOM's warm-up), and its exams say
    nothing of it. Runs that never weigh do not count; -infinity if none does.
    """
    return max((_weighs_from(metrics) for metrics in runs), default=-np.inf)


def _weighs_from(metrics: pd.DataFrame) -> float:
    """The step of the first fit with unequal weights; -infinity without one."""
    if ESS not in metrics:
        return -np.inf
    weighed = metrics.loc[metrics[ESS] < 1, "env_step"]
    return float(weighed.min()) if len(weighed) else -np.inf
