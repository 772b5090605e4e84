"""When does weighting help? Models of growing capacity, fitted with every way of weighing.

Weights for a shifted distribution help if a model is too small for the whole buffer (Shimodaira
2000), and have little effect if a network fits everything (Byrd and Lipton 2019).
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import astuple
from math import exp, log, nan
from statistics import median
from typing import Any, Literal

import numpy as np

from tom.studies.footprint import UNIFORM
from tom.studies.frozen import Outcome
from tom.studies.head_to_head import QUESTIONS, comparisons

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
    """One row for each way and model: the median ratio, its quartiles, how often it is below 1.

    Without those that share no moment and seed with uniform weights.
    """
    rows = []
    values = {ahead: list(ratios(outcomes, ahead)) for ahead in AHEAD}
    compared = {(one.way, model) for one, model, _ in values["error"]}
    for way in dict.fromkeys(one.way for one in outcomes if one.way != UNIFORM):
        for model in (each for each in _models(outcomes) if (way, each) in compared):
            row: dict[str, Any] = {"way": way, "model": model}
            for ahead, name in AHEAD.items():
                of = [r for one, m, r in values[ahead] if one.way == way and m == model]
                row |= {
                    name: median(of),
                    f"{name}, lower quartile": float(np.quantile(of, 0.25)),
                    f"{name}, upper quartile": float(np.quantile(of, 0.75)),
                    f"{name}, below 1": sum(r < 1 for r in of) / len(of),
                }
            rows.append(row | {"n": sum(one.way == way for one in outcomes)})
    return rows


def head_to_head(outcomes: Sequence[Outcome]) -> list[dict[str, Any]]:
    """One row per question of two ways and model: the ratio of their errors one step ahead.

    The ratio is the exponential of the mean difference of logarithms, and so are its interval and
    the ratio in each task.
    """
    rows = []
    for model in _models(outcomes):
        for one in comparisons(outcomes, lambda outcome, model=model: _log_error(outcome, model)):
            ratio, low, high = np.exp(astuple(one.difference))
            pair = {"way": one.way, "against": one.against, "model": model}
            rows.append(
                pair
                | {"ratio": ratio, "low": low, "high": high, "less at": one.better, "n": one.n}
                | one.by_recording
                | {env: exp(gap) for env, gap in one.by_task.items()}
            )
    return sorted(rows, key=lambda row: list(QUESTIONS).index((row["way"], row["against"])))


def verdict(outcomes: Sequence[Outcome]) -> list[str]:
    """For each model the way with the lowest error, and whether the difference exceeds noise."""
    rows, said = summary(outcomes), []
    for model in dict.fromkeys(row["model"] for row in rows):
        here = sorted((r for r in rows if r["model"] == model), key=lambda row: row["one step"])
        best, most = here[0], here[-1]
        middle = f"{best['one step, lower quartile']:.2f} to {best['one step, upper quartile']:.2f}"
        less = f"less in {best['one step, below 1']:.0%} of {best['n']}"
        said.append(
            f"Model {model}: {best['way']} errs least, {best['one step']:.2f} of the error under "
            f"uniform weights one step ahead (middle half of the moments {middle}, {less}), "
            f"{best['five steps']:.2f} five steps ahead; most under {most['way']}, "
            f"{most['one step']:.2f}."
        )
    return said + _answers(head_to_head(outcomes))


def _answers(rows: Sequence[dict[str, Any]]) -> list[str]:
    """The answer to each question of two ways in words, all models in one sentence."""
    said = []
    for (way, against), question in QUESTIONS.items():
        told = [
            f"{row['model']} {row['ratio']:.2f}{_bounds(row)} "
            f"(less at {row['less at']} of {row['n']}, p = {row['p']:.2f})"
            for row in rows
            if (row["way"], row["against"]) == (way, against)
        ]
        if told:
            said.append(f"{question} {way}'s error over {against}'s: {'; '.join(told)}.")
    return said


def _bounds(row: dict[str, Any]) -> str:
    return f" [{row['low']:.2f}, {row['high']:.2f}]" if np.isfinite(row["low"]) else ""


def _models(outcomes: Sequence[Outcome]) -> list[str]:
    return list(dict.fromkeys(error.model for one in outcomes for error in one.errors))


def _log_error(outcome: Outcome, model: str) -> float:
    """Logarithm of the model's error one step ahead; NaN if it was not fitted."""
    return next((log(error.error) for error in outcome.errors if error.model == model), nan)


def _errors(outcomes: Sequence[Outcome], ahead: Ahead) -> Iterator[tuple[Outcome, Key, float]]:
    for one in outcomes:
        for error in one.errors:
            key = (one.recording, one.step, one.seed, error.model)
            yield one, key, getattr(error, ahead)
