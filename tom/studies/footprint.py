"""Are the weights where the policy goes? Every way of weighing on the same frozen buffers.

Replay buffers of runs and of recordings of SAC, as they stood at steps whose policy was kept, are
weighed by every way, and it is measured how near that brings each to episodes that the policy of
that step makes anew. Runs must be whole, or small copies made with --keep buffer policies.
"""

from argparse import ArgumentParser, Namespace
from collections.abc import Sequence
from functools import partial
from operator import itemgetter
from statistics import median

import numpy as np
from matplotlib.figure import Figure

from tom.reports.figures import learner_colour, log_ticks, strips
from tom.studies.frozen import UNIFORM, WAYS
from tom.studies.moments import (
    QUESTIONS,
    add_measuring,
    comparisons,
    findings,
    measured,
    over_recordings,
    spanned,
    telling,
)
from tom.studies.study import Findings, Lab, Row, Study

LEAST = 0.03
"""distances below it are drawn at it: the axis is logarithmic"""
CAPTION = (
    "Energy distance of (s, a, s' - s), z-scored, between the weighted buffer and fresh episodes "
    "of the policy, over that of the unweighted buffer (1: no better than no weights). A point a "
    f"moment of a run, the stroke is their median; points below {LEAST} are drawn there. Moments "
    "whose distances are lost in noise are left out."
)


def add_options(parser: ArgumentParser) -> None:
    add_measuring(parser, list(WAYS))


def find(args: Namespace, lab: Lab) -> Findings:
    outcomes = measured(args, lab)
    figure = CAPTION, partial(footprint_figure, outcomes)
    pairs = head_to_head(outcomes)
    return findings(
        args, "footprint", verdict(outcomes), summary(outcomes), outcomes, figure, pairs=pairs
    )


def summary(outcomes: Sequence[Row]) -> list[Row]:
    """One row per way: its distance to the policy's footprint relative to uniform weights.

    Outcomes that say nothing (`telling`) do not count. A recording's score is the median over its
    moments and seeds. The mean over tasks of the mean over recordings has a stratified bootstrap
    interval over recordings.
    """
    rows, outcomes = [], telling(outcomes)
    for way in dict.fromkeys(one["way"] for one in outcomes):
        of = [one for one in outcomes if one["way"] == way]
        score = over_recordings((one["env"], one["recording"], one["footprint"]) for one in of)
        of_policy = sum(one["ends_policy"] for one in of)
        rows.append(
            {
                "way": way,
                "distance": score.value,
                "low": score.low,
                "high": score.high,
                "below uniform": sum(one["footprint"] < 1 for one in of) / len(of),
                **{
                    env: median(one["footprint"] for one in of if one["env"] == env)
                    for env in dict.fromkeys(one["env"] for one in of)
                },
                "ess": median(one["ess"] for one in of),
                "ends over policy's": sum(o["ends"] for o in of) / of_policy
                if of_policy
                else np.nan,
                "n": len(of),
            }
        )
    return rows


def head_to_head(outcomes: Sequence[Row]) -> list[Row]:
    """One row per question of two ways: the difference of their distances, with its interval.

    Outcomes that say nothing (`telling`) do not count. Without questions about uniform weights,
    whose distance is 1: `summary` answers them.
    """
    rows = comparisons(telling(outcomes), itemgetter("footprint"), "difference", "nearer at")
    return [row for row in rows if row["against"] != UNIFORM]


def verdict(outcomes: Sequence[Row]) -> list[str]:
    """The tables in words."""
    told = [row for row in summary(outcomes) if row["way"] != UNIFORM]
    said, counted = [], telling(outcomes)
    if counted:
        noise = [one["footprint_noise"] for one in counted if one["way"] == UNIFORM] or [np.nan]
        runs, envs = ({one[name] for one in counted} for name in ("recording", "env"))
        said.append(
            f"{len(_moments(counted))} moments of {len(runs)} runs in {len(envs)} tasks. 1 is no "
            "nearer to what the policy does than uniform weights, 0 the policy itself; two samples "
            f"of the policy are {median(noise):.2g} apart (median)."
        )
    if told:
        nearest = sorted(told, key=lambda row: row["distance"])[:3]
        said.append(f"Nearest: {', '.join(map(_named, nearest))}.")
    if lost := _moments(outcomes) - _moments(counted):
        where = ", ".join(f"{recording} at {step}" for recording, step in sorted(lost))
        said.append(
            "Not counted, because the unweighted buffer is no farther from the policy than two "
            f"samples of it are from each other, and distances are noise: {where}."
        )
    if worse := [row for row in told if row["distance"] > 1]:
        named = ", ".join(map(_named, worse))
        said.append(f"Further from the policy than no weights at all: {named}.")
    return said + [
        f"{QUESTIONS[row['way'], row['against']]} {row['way']} less {row['against']}: "
        f"{spanned(row, 'difference')}, nearer at {row['nearer at']} of "
        f"{row['n']} moments, in most of them on {row['better on']} of {row['recordings']} "
        f"recordings (sign test p = {row['p']:.2f})."
        for row in head_to_head(outcomes)
    ]


def _named(row: Row) -> str:
    return f"{row['way']} {spanned(row, 'distance')}"


def _moments(outcomes: Sequence[Row]) -> set[tuple[str, int]]:
    return {(one["recording"], one["step"]) for one in outcomes}


def footprint_figure(outcomes: Sequence[Row]) -> Figure:
    """One panel per task: distance to the policy relative to uniform weights, log axis."""
    drawn = [one for one in telling(outcomes) if one["way"] != UNIFORM]
    colours = {name: learner_colour(way.learner or "") for name, way in WAYS.items()}
    points = [(one["env"], one["way"], max(one["footprint"], LEAST)) for one in drawn]
    cut = any(one["footprint"] < LEAST for one in drawn)
    what = "distance to the policy's footprint over that of uniform weights"
    what += f" (drawn at {LEAST} if below it)" * cut
    figure = strips(colours, points, 1.0, what, "every distance is lost in noise")
    for ax in figure.axes:
        ax.set_xscale("log")
        log_ticks(ax.xaxis, [0.1, 0.2, 0.5, 1, 2, 4])
    return figure


STUDY = Study(
    "footprint",
    "Where the weights lie",
    __doc__,
    "TOM weighs the replay buffer so that its distribution of transitions matches that of the "
    "current policy (section 4). The paper measures the match on road-and-rocks alone.",
    add_options,
    find,
)
