"""Are the weights where the policy goes? Every way of weighing on the same frozen buffers.

Takes replay buffers of runs and of SAC recordings as they were at steps whose policy was kept,
weighs them in every way, and measures how near that brings each to new episodes of that step's
policy. Runs must be whole, or small copies made with --keep buffer policies.
"""

from argparse import ArgumentParser, Namespace
from collections.abc import Iterator, Sequence
from operator import itemgetter
from statistics import median

import numpy as np
from matplotlib.figure import Figure

from tom.reports.figures import learner_colour, strips
from tom.studies.frozen import LABELS, MENDED, PRINTED, UNIFORM, WAYS
from tom.studies.moments import (
    add_measure_options,
    answer_sentences,
    comparisons,
    findings,
    informative_outcomes,
    of_test,
    outcomes_of,
    over_recordings,
    way_point,
    with_interval,
    word_of_rows,
)
from tom.studies.study import Findings, Row
from tom.studies.verdicts import Tables, Verdict

TITLE = "Where the weights lie"
QUESTION = "Do TOM's weights bring a buffer nearer to what its policy does?"
CLAIM = (
    "TOM weighs the replay buffer so that its distribution of transitions matches that of the "
    "current policy (section 4). The paper measures the match on road-and-rocks alone."
)
LEAST = 0.03
"""distances below it are drawn at it: the axis is logarithmic"""
CAPTION = (
    "Energy distance of (s, a, s' - s), z-scored, between the weighted buffer and fresh episodes "
    "of the policy, over that of the unweighted buffer (1: no nearer than without weights). One "
    f"point per moment; the stroke is their median; points below {LEAST} are drawn there. Moments "
    "whose distances are lost in noise are left out."
)


def add_options(parser: ArgumentParser) -> None:
    add_measure_options(parser, list(WAYS))


def find(args: Namespace) -> Findings:
    outcomes = outcomes_of(args)
    tables = {"summary": summary(outcomes), "head-to-head": head_to_head(outcomes)}
    figures = {"footprint": (CAPTION, footprint_figure(outcomes))}
    return findings(args, in_sentences(outcomes), tables, outcomes, figures)


def summary(outcomes: Sequence[Row]) -> list[Row]:
    """One row per way: its distance to the policy's footprint relative to uniform weights.

    Only `informative_outcomes` count. A recording's score is the median over its moments and seeds.
    The mean over tasks of the mean over recordings has a stratified bootstrap interval over
    recordings.
    """
    rows, outcomes = [], informative_outcomes(outcomes)
    envs = dict.fromkeys(one["env"] for one in outcomes)
    for way in dict.fromkeys(one["way"] for one in outcomes):
        of = [one for one in outcomes if one["way"] == way]
        score = over_recordings((one["env"], one["recording"], one["footprint"]) for one in of)
        of_policy = sum(one["ends_policy"] for one in of)
        by_env = {env: [one["footprint"] for one in of if one["env"] == env] for env in envs}
        rows.append(
            {
                "way": way,
                **score.columns("distance"),
                "below uniform": sum(one["footprint"] < 1 for one in of) / len(of),
                **{env: median(values) if values else np.nan for env, values in by_env.items()},
                "ess": median(one["ess"] for one in of),
                "ends over policy's": sum(one["ends"] for one in of) / of_policy
                if of_policy
                else np.nan,
                "n": len(of),
            }
        )
    return rows


def head_to_head(outcomes: Sequence[Row]) -> list[Row]:
    """One row per question of two ways: the difference of their distances, with its interval.

    Only `informative_outcomes` count. Without questions about uniform weights, whose distance is 1:
    `summary` answers them.
    """
    return [row for row in _comparisons(outcomes) if row["against"] != UNIFORM]


def _comparisons(outcomes: Sequence[Row]) -> Iterator[Row]:
    told = informative_outcomes(outcomes)
    return comparisons(told, itemgetter("footprint"), "difference", "nearer at")


def in_sentences(outcomes: Sequence[Row]) -> list[str]:
    """The tables in words."""
    sentences, counted = [], informative_outcomes(outcomes)
    if counted:
        noise = [one["footprint_noise"] for one in counted if one["way"] == UNIFORM] or [np.nan]
        runs, envs = ({one[name] for one in counted} for name in ("recording", "env"))
        sentences.append(
            f"{len(_moments(counted))} moments of {len(runs)} runs in {len(envs)} tasks. 1 is no "
            "nearer to what the policy does than uniform weights, 0 the policy itself; two samples "
            f"of the policy are {median(noise):.2g} apart (median)."
        )
    ranked = sorted(
        (row for row in summary(outcomes) if row["way"] != UNIFORM), key=itemgetter("distance")
    )
    worse = [row for row in ranked if row["distance"] > 1]
    for what, rows in (
        ("Nearest", ranked[:3]),
        ("Further from the policy than no weights at all", worse),
    ):
        if rows:
            named = ", ".join(f"{row['way']} {with_interval(row, 'distance')}" for row in rows)
            sentences.append(f"{what}: {named}.")
    if lost := _moments(outcomes) - _moments(counted):
        where = ", ".join(f"{recording} at {step}" for recording, step in sorted(lost))
        sentences.append(
            "Not counted, because the unweighted buffer is no farther from the policy than two "
            f"samples of it are from each other, and distances are noise: {where}."
        )
    return sentences + answer_sentences(head_to_head(outcomes), "difference", "nearer at")


def verdict(tables: Tables) -> Verdict:
    """By the distances of TOM as printed and mended; recency and policy distance speak against."""
    rows = {row["way"]: row for row in tables["summary"]}
    ours = [
        test | rows[test["way"]]
        for test in _comparisons(tables["moments"])
        if test["against"] == UNIFORM and test["way"] in (PRINTED, MENDED)
    ]
    distances = [
        f"{LABELS[row['way']]} {with_interval(row, 'distance')} ({of_test(row)})" for row in ours
    ]
    sentence = (
        "A weighted buffer keeps this share of its distance to what the policy does next: "
        f"{', '.join(distances)}. Recorded trainings, {ours[0]['n']:.0f} moments."
    )
    rivals = {"recency": "Recency", "policy-distance": "The policies' distance"}
    rival_sentences = [
        f"{name}, which trains nothing, keeps {rows[rival]['distance']:.2f}; {LABELS[pair['way']]} "
        f"is nearer than {LABELS[pair['against']]} on {pair['better on']:.0f} of "
        f"{pair['recordings']:.0f} recordings (p {pair['p']:.2g})."
        for pair in tables["head-to-head"]
        for rival, name in rivals.items()
        if {pair["way"], pair["against"]} == {MENDED, rival}
    ]
    shown = sorted((rows[way] for way in LABELS if way in rows), key=itemgetter("distance"))
    points = [way_point(row, "distance", LABELS[row["way"]]) for row in shown]
    axis = "distance to the policy (1: without weights)"
    return Verdict(word_of_rows(ours), sentence, " ".join(rival_sentences), axis, 1, points)


def _moments(outcomes: Sequence[Row]) -> set[tuple[str, int]]:
    return {(one["recording"], one["step"]) for one in outcomes}


def footprint_figure(outcomes: Sequence[Row]) -> Figure:
    """One panel per task: distance to the policy relative to uniform weights, log axis."""
    points = [
        (one["env"], one["way"], max(one["footprint"], LEAST))
        for one in informative_outcomes(outcomes)
        if one["way"] != UNIFORM
    ]
    colours = {name: learner_colour(way.learner or "") for name, way in WAYS.items()}
    what = "distance to the policy's footprint over that of uniform weights"
    return strips(colours, points, 1.0, what, [0.1, 0.2, 0.5, 1, 2, 4])
