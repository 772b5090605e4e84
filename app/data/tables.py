"""What the comparison shows, as tables to read and to take away. Pure functions."""

from collections.abc import Sequence

import numpy as np
import pandas as pd

from app.data.aggregate import Curve, Group, interval
from app.theme import learner_label
from tom.analysis.statistics import Interval


def summary(grouped: Sequence[Group]) -> pd.DataFrame:
    """A row a group: runs, the last step that all reach, final and best with their intervals.

    Final and best are those up to that step; NaN where a run began only after it.
    """
    rows = []
    for group in grouped:
        last = float(min(curve.step[-1] for curve in group.curves))
        cut = [curve.until(last) for curve in group.curves]
        row = {
            "environment": group.env,
            "learner": learner_label(group.learner),
            "preset": group.preset,
            "settings": group.variant,
            "n": group.n,
            "seeds": ", ".join(str(curve.seed) for curve in group.curves),
            "steps": last,
        }
        for name in ("final", "best"):
            values = np.array([getattr(curve, name) for curve in cut])
            # Without the runs that began later it would be the statistic of fewer than n.
            whole = np.isfinite(values).all()
            found = interval(values, group.statistic) if whole else Interval(*[np.nan] * 3)
            row |= {name: found.value, f"{name} low": found.low, f"{name} high": found.high}
        rows.append(row)
    return pd.DataFrame(rows)


def bands(grouped: Sequence[Group], x: str = "env_step") -> pd.DataFrame:
    """A row a group and step: what the figures' lines and bands show, before any smoothing."""
    parts = [
        pd.DataFrame(
            {
                "env": group.env,
                "learner": group.learner,
                "preset": group.preset,
                "settings": group.variant,
                x: group.step,
                group.statistic: group.mean,
                "low": group.low,
                "high": group.high,
                "runs": group.count,
            }
        )
        for group in grouped
    ]
    return pd.concat(parts) if parts else pd.DataFrame()


def runs(curves: Sequence[Curve], x: str = "env_step") -> pd.DataFrame:
    """A row a run and step."""
    parts = [
        pd.DataFrame(
            {
                "run": curve.run_id,
                "env": curve.env,
                "learner": curve.learner,
                "seed": curve.seed,
                x: curve.step,
                "value": curve.value,
            }
        )
        for curve in curves
    ]
    return pd.concat(parts) if parts else pd.DataFrame()
