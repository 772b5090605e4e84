"""Do the weights lie where the policy goes? Every way of weighing on the same frozen buffers."""

from collections.abc import Sequence
from statistics import median
from typing import Any

import numpy as np

from tom.analysis.statistics import Interval, interval, mean
from tom.studies.frozen import Outcome

UNIFORM = "uniform"


def summary(found: Sequence[Outcome]) -> list[dict[str, Any]]:
    """A row for each way: its distance to the policy's footprint over that of uniform weights.

    A recording's score is the median over its moments and seeds; the mean over tasks of the mean
    over recordings has a stratified bootstrap interval over recordings.
    """
    rows = []
    for way in dict.fromkeys(one.way for one in found):
        of = [one for one in found if one.way == way and np.isfinite(one.footprint)]
        if not of:
            continue
        score = aggregate(of)
        by_env = {
            env: median(one.footprint for one in of if one.env == env)
            for env in dict.fromkeys(one.env for one in of)
        }
        rows.append(
            {
                "way": way,
                "distance": score.value,
                "low": score.low,
                "high": score.high,
                "below uniform": sum(one.footprint < 1 for one in of) / len(of),
                **by_env,
                "ess": median(one.ess for one in of),
                "ends over policy's": _ends(of),
                "n": len(of),
            }
        )
    return rows


def aggregate(found: Sequence[Outcome]) -> Interval:
    """Mean over tasks of the recordings' median distances, with its interval."""
    tasks = []
    for env in dict.fromkeys(one.env for one in found):
        here = [one for one in found if one.env == env]
        names = dict.fromkeys(one.recording for one in here)
        tasks.append([median(o.footprint for o in here if o.recording == name) for name in names])
    scores = np.full((max(map(len, tasks)), len(tasks)), np.nan)
    for column, values in enumerate(tasks):
        scores[: len(values), column] = values
    return interval(scores, mean, np.random.default_rng(0))


def verdict(found: Sequence[Outcome]) -> list[str]:
    """What the table says, in words."""
    rows = [row for row in summary(found) if row["way"] != UNIFORM]
    moments = {(one.recording, one.step) for one in found}
    said = [
        f"{len(moments)} moments of {len({one.recording for one in found})} runs in "
        f"{len({one.env for one in found})} tasks. 1 is no nearer to what the policy does than "
        f"uniform weights, 0 the policy itself; two samples of the policy are "
        f"{_noise(found):.2f} apart (median)."
    ]
    best = sorted(rows, key=lambda row: row["distance"])[:3]
    told = (f"{row['way']} {row['distance']:.2f} ({_bounds(row)})" for row in best)
    said.append(f"Nearest: {', '.join(told)}.")
    worse = [f"{row['way']} {row['distance']:.2f}" for row in rows if row["distance"] > 1]
    if worse:
        said.append(f"Further from the policy than no weights at all: {', '.join(worse)}.")
    return said


def paired(found: Sequence[Outcome], way: str, rival: str) -> tuple[int, int]:
    """At how many moments `way` is nearer than `rival`, of how many that both have."""
    keys = [(one.recording, one.step, one.seed) for one in found]
    of = {
        name: {k: o.footprint for k, o in zip(keys, found, strict=True) if o.way == name}
        for name in (way, rival)
    }
    shared = of[way].keys() & of[rival].keys()
    return sum(of[way][key] < of[rival][key] for key in shared), len(shared)


def _ends(found: Sequence[Outcome]) -> float:
    """Share of the weight on endings over the policy's share, pooled; NaN where nothing ends."""
    policy = sum(one.ends_policy for one in found)
    return sum(one.ends for one in found) / policy if policy else float("nan")


def _noise(found: Sequence[Outcome]) -> float:
    return median(one.footprint_noise for one in found if one.way == UNIFORM)


def _bounds(row: dict[str, Any]) -> str:
    return f"{row['low']:.2f} to {row['high']:.2f}" if np.isfinite(row["low"]) else "one run a task"
