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


def gaps(trials: Sequence[Improvement], way: str, place: str) -> list[Value]:
    """Return with the way's weights at `place` less that with uniform weights, trial by trial."""
    uniform = {_key(trial): trial.both for trial in trials if trial.way == UNIFORM}
    differences = [
        (trial.env, trial.recording, getattr(trial, place) - uniform[_key(trial)])
        for trial in trials
        if trial.way == way and _key(trial) in uniform
    ]
    return [value for value in differences if isfinite(value[2])]


def summary(trials: Sequence[Improvement]) -> list[dict[str, Any]]:
    """One row for the returns before, one for those with uniform weights, and one for each other
    way and place: median differences by task, and how often it is better."""
    plain = [trial for trial in trials if trial.way == UNIFORM]
    envs = list(dict.fromkeys(trial.env for trial in plain))
    rows = [
        _row("none", "return before", envs, [(trial.env, trial.before) for trial in plain]),
        _row(UNIFORM, "return", envs, [(trial.env, trial.both) for trial in plain]),
    ]
    for way in dict.fromkeys(trial.way for trial in trials if trial.way != UNIFORM):
        for place in PLACES:
            differences = gaps(trials, way, place)
            by_env = [(env, gap) for env, _, gap in differences]
            row = _row(way, f"difference, weights in {_where(place)}", envs, by_env)
            rows.append(row | _wins(differences))
    return rows


def verdict(trials: Sequence[Improvement]) -> list[str]:
    """The table in words, the noise, and what cannot be said."""
    keys = {_key(trial) for trial in trials}
    moments = {(recording, step) for recording, step, _ in keys}
    recordings = {recording for recording, _ in moments}
    lost = sum(not isfinite(trial.model + trial.starts + trial.both) for trial in trials)
    said = [
        f"{len(moments)} moments of {len(recordings)} runs, {len(keys)} trials of each way. "
        + _noise(trials)
    ]
    if lost:
        said.append(f"SAC diverged in {lost} trials, which are left out.")
    return said + [_sentence(row) for row in summary(trials) if row["recordings"] != ""]


def _row(
    way: str, what: str, envs: Sequence[str], values: Sequence[tuple[str, float]]
) -> dict[str, Any]:
    """The median of the values (env, value) in each of `envs`, with empty columns for wins."""
    row: dict[str, Any] = {"way": way, "what": what}
    for env in envs:
        finite = [value for task, value in values if task == env and isfinite(value)]
        row[env] = median(finite) if finite else float("nan")
    return row | {"better in trials": "", "n": len(values), "better on": "", "recordings": "",
                  "p": ""}  # fmt: skip


def _wins(differences: Sequence[Value]) -> dict[str, Any]:
    signs, better = sign_test(differences), sum(gap > 0 for _, _, gap in differences)
    return {
        "better in trials": better,
        "n": len(differences),
        "better on": signs.above,
        "recordings": signs.n,
        "p": signs.p,
    }


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


def _noise(trials: Sequence[Improvement]) -> str:
    """How far two seeds of uniform weights lie apart at the same moment, by task."""
    by_moment: dict[tuple[str, str, int], list[float]] = {}
    for trial in trials:
        if trial.way == UNIFORM:
            moment = trial.env, trial.recording, trial.step
            by_moment.setdefault(moment, []).append(trial.both)
    apart: dict[str, list[float]] = {}
    for (env, _, _), values in by_moment.items():
        apart.setdefault(env, []).extend(abs(a - b) for a, b in combinations(values, 2))
    told = [f"{env} {median(of):.0f}" for env, of in apart.items() if of]
    if not told:
        return "One seed: how far chance moves a return is not known."
    return f"Two seeds of uniform weights differ by (median): {', '.join(told)}."


def _where(place: str) -> str:
    return "both" if place == "both" else f"the {place} alone"


def _key(trial: Improvement) -> tuple[str, int, int]:
    return trial.recording, trial.step, trial.seed
