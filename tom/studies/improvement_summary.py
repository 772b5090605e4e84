"""What weights did for the policy: tables, statistics and words of `tom.studies.improvement`.

Returns of different tasks have no common unit, and those of one moment vary by chance more than by
weights. So what counts is on how many recordings a way is better in most of its trials (exact sign
test); differences of returns are given task by task.
"""

from collections.abc import Mapping, Sequence
from itertools import combinations
from math import isfinite
from statistics import median
from typing import Any

from tom.studies.footprint import UNIFORM
from tom.studies.improvement import Improvement
from tom.studies.recordings import Value, sign_test

PLACES = ("model", "starts", "both")
"""where the weights act"""


def gaps(found: Sequence[Improvement], way: str, place: str) -> list[Value]:
    """Return with the way's weights at `place` less that with uniform weights, trial by trial."""
    base = {_trial(one): one.both for one in found if one.way == UNIFORM}
    every = [
        (one.env, one.recording, getattr(one, place) - base[_trial(one)])
        for one in found
        if one.way == way and _trial(one) in base
    ]
    return [value for value in every if isfinite(value[2])]


def summary(found: Sequence[Improvement]) -> list[dict[str, Any]]:
    """One row for the returns before, one for those with uniform weights, and one for each other
    way and place: median differences by task, and how often it is better."""
    plain = [one for one in found if one.way == UNIFORM]
    rows: list[dict[str, Any]] = [
        _row("none", "return before", plain, [(one.env, one.before) for one in plain]),
        _row(UNIFORM, "return", plain, [(one.env, one.both) for one in plain]),
    ]
    for way in dict.fromkeys(one.way for one in found if one.way != UNIFORM):
        for place in PLACES:
            of = gaps(found, way, place)
            told = [(env, gap) for env, _, gap in of]
            row = _row(way, f"difference, weights in {_where(place)}", plain, told)
            rows.append(row | _wins(of))
    return rows


def verdict(found: Sequence[Improvement]) -> list[str]:
    """The table in words, the noise, and what cannot be said."""
    trials = {_trial(one) for one in found}
    lost = sum(not isfinite(one.model + one.starts + one.both) for one in found)
    said = [
        f"{len({trial[:2] for trial in trials})} moments of {len({t[0] for t in trials})} runs, "
        f"{len(trials)} trials of each way. " + _noise(found)
    ]
    if lost:
        said.append(f"SAC diverged in {lost} trials, which are left out.")
    return said + [_sentence(row) for row in summary(found) if row["recordings"] != ""]


def _row(
    way: str, what: str, plain: Sequence[Improvement], values: Sequence[tuple[str, float]]
) -> dict[str, Any]:
    row: dict[str, Any] = {"way": way, "what": what}
    for env in dict.fromkeys(one.env for one in plain):
        of = [value for task, value in values if task == env and isfinite(value)]
        row[env] = median(of) if of else float("nan")
    return row | {"better in trials": "", "n": len(values), "better on": "", "recordings": "",
                  "p": ""}  # fmt: skip


def _wins(of: Sequence[Value]) -> dict[str, Any]:
    signs, better = sign_test(of), sum(gap > 0 for _, _, gap in of)
    numbers = {"better on": signs.above, "recordings": signs.n, "p": signs.p}
    return {"better in trials": better, "n": len(of), **numbers}


def _sentence(row: Mapping[str, Any]) -> str:
    less = row["recordings"] - row["better on"]
    told = (
        f"{row['way']}, {row['what'].partition(', ')[2]}: better in {row['better in trials']} of "
        f"{row['n']} trials; better in most of them on {row['better on']} recordings, worse on "
        f"{less} (sign test p = {row['p']:.2f})"
    )
    if row["p"] >= 0.05:
        return f"{told}: undecided."
    return f"{told}: {'better' if row['better on'] > less else 'worse'} than uniform weights."


def _noise(found: Sequence[Improvement]) -> str:
    """How far two seeds of uniform weights lie apart at the same moment, by task."""
    by_moment: dict[tuple[str, str, int], list[float]] = {}
    for one in found:
        if one.way == UNIFORM:
            by_moment.setdefault((one.env, one.recording, one.step), []).append(one.both)
    apart: dict[str, list[float]] = {}
    for (env, _, _), values in by_moment.items():
        apart.setdefault(env, []).extend(abs(a - b) for a, b in combinations(values, 2))
    told = [f"{env} {median(of):.0f}" for env, of in apart.items() if of]
    if not told:
        return "One seed: how far chance moves a return is not known."
    return f"Two seeds of uniform weights differ by (median): {', '.join(told)}."


def _where(place: str) -> str:
    return "both" if place == "both" else f"the {place} alone"


def _trial(one: Improvement) -> tuple[str, int, int]:
    return one.recording, one.step, one.seed
