"""Are the weights where the policy goes? Every way of weighing on the same frozen buffers."""

from collections.abc import Sequence
from statistics import median
from typing import Any

import numpy as np

from tom.exams.energy import informative
from tom.studies.frozen import Outcome
from tom.studies.head_to_head import QUESTIONS, comparisons
from tom.studies.recordings import over_recordings

UNIFORM = "uniform"


def summary(outcomes: Sequence[Outcome]) -> list[dict[str, Any]]:
    """One row per way: its distance to the policy's footprint relative to uniform weights.

    Outcomes that say nothing (`telling`) do not count. A recording's score is the median over its
    moments and seeds. The mean over tasks of the mean over recordings has a stratified bootstrap
    interval over recordings.
    """
    rows, outcomes = [], telling(outcomes)
    for way in dict.fromkeys(one.way for one in outcomes):
        of = [one for one in outcomes if one.way == way]
        score = over_recordings((one.env, one.recording, one.footprint) for one in of)
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


def head_to_head(outcomes: Sequence[Outcome]) -> list[dict[str, Any]]:
    """One row per question of two ways: the difference of their distances, with its interval.

    Outcomes that say nothing (`telling`) do not count. Without questions about uniform weights,
    whose distance is 1: `summary` answers them.
    """
    return [
        {
            "way": one.way,
            "against": one.against,
            "difference": one.difference.value,
            "low": one.difference.low,
            "high": one.difference.high,
            "nearer at": one.better,
            "n": one.n,
            **one.by_recording,
            **one.by_task,
        }
        for one in comparisons(telling(outcomes), lambda outcome: outcome.footprint)
        if one.against != UNIFORM
    ]


def verdict(outcomes: Sequence[Outcome]) -> list[str]:
    """A summary of the table in words."""
    rows = [row for row in summary(outcomes) if row["way"] != UNIFORM]
    counted = telling(outcomes)
    if not counted:
        return _not_counted(outcomes)
    said = [
        f"{len(_moments(counted))} moments of {len({one.recording for one in counted})} runs in "
        f"{len({one.env for one in counted})} tasks. 1 is no nearer to what the policy does than "
        f"uniform weights, 0 the policy itself; two samples of the policy are "
        f"{_near(_noise(counted))} apart (median)."
    ]
    if rows:  # weights other than uniform ones
        said.append(f"Nearest: {_nearest(rows)}.")
    said += _not_counted(outcomes)
    worse = [f"{row['way']} {row['distance']:.2f}" for row in rows if row["distance"] > 1]
    if worse:
        said.append(f"Further from the policy than no weights at all: {', '.join(worse)}.")
    return said + [_answer(row) for row in head_to_head(outcomes)]


def telling(outcomes: Sequence[Outcome]) -> list[Outcome]:
    """The outcomes whose distance was measured and is not lost in its noise (`informative`)."""
    says = informative([one.footprint_noise for one in outcomes])
    return [
        one for one, kept in zip(outcomes, says, strict=True) if kept and np.isfinite(one.footprint)
    ]


def _nearest(rows: Sequence[dict[str, Any]]) -> str:
    """The three nearest ways of a summary, in words."""
    best = sorted(rows, key=lambda row: row["distance"])[:3]
    return ", ".join(f"{row['way']} {row['distance']:.2f} ({_bounds(row)})" for row in best)


def _not_counted(outcomes: Sequence[Outcome]) -> list[str]:
    """A line on the moments whose noise drowns their distances."""
    lost = _moments(outcomes) - _moments(telling(outcomes))
    if not lost:
        return []
    where = ", ".join(f"{recording} at {step}" for recording, step in sorted(lost))
    return [
        "Not counted, because the unweighted buffer is no farther from the policy than two samples "
        f"of it are from each other, and distances are noise: {where}."
    ]


def _moments(outcomes: Sequence[Outcome]) -> set[tuple[str, int]]:
    return {(one.recording, one.step) for one in outcomes}


def _answer(row: dict[str, Any]) -> str:
    """The answer to a question of two ways in words."""
    way, against = row["way"], row["against"]
    bounds = f" [{row['low']:+.2f}, {row['high']:+.2f}]" if np.isfinite(row["low"]) else ""
    return (
        f"{QUESTIONS[way, against]} {way} less {against}: {row['difference']:+.2f}{bounds}, "
        f"nearer at {row['nearer at']} of {row['n']} moments, in most of them on "
        f"{row['better on']} of {row['recordings']} recordings (sign test p = {row['p']:.2f})."
    )


def _ends(outcomes: Sequence[Outcome]) -> float:
    """Share of weight on endings relative to the policy's, pooled; NaN if there are none."""
    policy = sum(one.ends_policy for one in outcomes)
    return sum(one.ends for one in outcomes) / policy if policy else float("nan")


def _noise(outcomes: Sequence[Outcome]) -> float:
    """The median distance of two samples of the policy; NaN without uniform weights."""
    return median([one.footprint_noise for one in outcomes if one.way == UNIFORM] or [np.nan])


def _near(distance: float) -> str:
    return "less than 0.01" if distance < 0.005 else f"{distance:.2f}"


def _bounds(row: dict[str, Any]) -> str:
    return f"{row['low']:.2f} to {row['high']:.2f}" if np.isfinite(row["low"]) else "one run a task"
