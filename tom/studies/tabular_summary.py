"""The tabular study's estimates in brief: medians and worst values, and the acceptance."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from tom.studies.checks import Check, at_least, at_most
from tom.studies.tabular import Score

Rows = Sequence[Mapping[str, Any]]


def summary(rows: Iterable[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """For each variant, in order: number of runs, median and worst value of each measure.

    Those of the mean weight are over the runs without KL, under which it is 1 whatever the error.
    """
    by_variant: dict[str, list[Mapping[str, Any]]] = {}
    for row in rows:
        by_variant.setdefault(row["variant"], []).append(row)
    return [{"variant": name, **_summarise(group)} for name, group in by_variant.items()]


def _summarise(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    column = {name: np.array([row[name] for row in rows], float) for name in Score.__annotations__}
    means = [row["raw_mean"] for row in rows if row["divergence"] != "kl"]
    return {
        "runs": len(rows),
        "spearman": float(np.median(column["spearman"])),
        "spearman_worst": float(column["spearman"].min()),
        "l1": float(np.median(column["l1"])),
        "l1_worst": float(column["l1"].max()),
        "flow_residual": float(np.median(column["flow_residual"])),
        "flow_residual_worst": float(column["flow_residual"].max()),
        "log_ratio": float(np.median(column["log_ratio"])),
        "log_ratio_worst": float(column["log_ratio"].min()),
        **_around_one("raw_mean", means),
        **_around_one("ends_ratio", [row["ends_ratio"] for row in rows]),  # where episodes end
    }


def _around_one(name: str, ratios: Sequence[float | None]) -> dict[str, float | None]:
    """Median and worst of what is 1 without an error; None if no ratio is known."""
    known = np.array([ratio for ratio in ratios if ratio is not None])
    if len(known) == 0:
        return {name: None, f"{name}_worst": None}
    worst = known[np.abs(known - 1).argmax()]
    return {name: float(np.median(known)), f"{name}_worst": float(worst)}


def acceptance(
    rows: Rows, same_policy: Rows, dense: Rows, stationary: Rows, mended: Rows
) -> list[Check]:
    """The checks of an estimator, over every family that has rows.

    `same_policy` are problems whose replay buffer comes from the policy itself, `dense` those of
    `dense_cases`, `stationary` and `mended` those of `ending_cases` with these two variants.
    """
    checks = near_exact("", rows)
    if same_policy:
        same = max(row["l1"] for row in same_policy)
        checks.append(at_most("pi = pi_D: relative L1 distance from 1, worst", same, 0.12))
    checks += near_exact("dense: ", dense) + near_exact("stationary: ", stationary)
    for name, group in (("stationary", stationary), ("mended", mended)):
        if group:
            off = abs(float(np.median([row["ends_ratio"] for row in group])) - 1)
            checks.append(at_most(f"{name}: weight on ends off the exact, median", off, 0.20))
    return checks


def near_exact(family: str, rows: Rows) -> list[Check]:
    """The checks of one family of problems; none if it has no rows."""
    if not rows:
        return []
    s = _summarise(rows)
    off = max(abs(row["raw_mean"] - 1) for row in rows)
    return [
        at_least(f"{family}rank correlation of the weights, median", s["spearman"], 0.95),
        at_least(f"{family}rank correlation of the weights, worst", s["spearman_worst"], 0.90),
        at_most(f"{family}relative L1 error, median", s["l1"], 0.12),
        at_most(f"{family}relative L1 error, worst", s["l1_worst"], 0.20),
        at_most(f"{family}flow residual, worst", s["flow_residual_worst"], 0.12),
        at_least(f"{family}logit against log ratio, worst", s["log_ratio_worst"], 0.95),
        at_most(f"{family}mean weight off the exact, worst", off, 0.05),
    ]
