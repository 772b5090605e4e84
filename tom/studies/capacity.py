"""When does weighting help? Models of growing capacity, fitted with every way of weighing.

Weights for a shifted distribution help if a model is too small for the whole buffer (Shimodaira
2000), and have little effect if a network fits everything (Byrd and Lipton 2019).
"""

from collections.abc import Iterator, Mapping, Sequence
from statistics import median
from typing import Any, Literal

import numpy as np

from tom.studies.footprint import UNIFORM
from tom.studies.frozen import Outcome

Ahead = Literal["error", "rollout_error"]
AHEAD: Mapping[Ahead, str] = {"error": "one step", "rollout_error": "five steps"}
Key = tuple[str, int, int, str]  # recording, step, seed, model


def ratios(outcomes: Sequence[Outcome], ahead: Ahead) -> Iterator[tuple[Outcome, str, float]]:
    """(outcome, model, error relative to uniform weights at the same moment and seed)."""
    base = {key: value for one, key, value in _errors(outcomes, ahead) if one.way == UNIFORM}
    for one, key, value in _errors(outcomes, ahead):
        if one.way != UNIFORM and key in base:
            yield one, key[3], value / base[key]


def summary(outcomes: Sequence[Outcome]) -> list[dict[str, Any]]:
    """One row for each way and model: the median ratio, its range, and how often it is below 1."""
    rows = []
    values = {ahead: list(ratios(outcomes, ahead)) for ahead in AHEAD}
    for way in dict.fromkeys(one.way for one in outcomes if one.way != UNIFORM):
        for model in dict.fromkeys(error.model for one in outcomes for error in one.errors):
            row: dict[str, Any] = {"way": way, "model": model}
            for ahead, name in AHEAD.items():
                of = [r for one, m, r in values[ahead] if one.way == way and m == model]
                row |= {
                    name: median(of),
                    f"{name}, low": float(np.quantile(of, 0.25)),
                    f"{name}, high": float(np.quantile(of, 0.75)),
                    f"{name}, below 1": sum(r < 1 for r in of) / len(of),
                }
            rows.append(row | {"n": sum(one.way == way for one in outcomes)})
    return rows


def verdict(outcomes: Sequence[Outcome]) -> list[str]:
    """For each model the way with the lowest error, and whether the difference exceeds noise."""
    rows, said = summary(outcomes), []
    for model in dict.fromkeys(row["model"] for row in rows):
        here = sorted((r for r in rows if r["model"] == model), key=lambda row: row["one step"])
        best, most = here[0], here[-1]
        middle = f"{best['one step, low']:.2f} to {best['one step, high']:.2f}"
        less = f"less in {best['one step, below 1']:.0%} of {best['n']}"
        said.append(
            f"Model {model}: {best['way']} errs least, {best['one step']:.2f} of the error under "
            f"uniform weights one step ahead (middle half of the moments {middle}, {less}), "
            f"{best['five steps']:.2f} five steps ahead; most under {most['way']}, "
            f"{most['one step']:.2f}."
        )
    return said


def _errors(outcomes: Sequence[Outcome], ahead: Ahead) -> Iterator[tuple[Outcome, Key, float]]:
    for one in outcomes:
        for error in one.errors:
            key = (one.recording, one.step, one.seed, error.model)
            yield one, key, getattr(error, ahead)
