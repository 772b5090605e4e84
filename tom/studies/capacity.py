"""For which models does weighting pay? Models of growing capacity, fitted by every way of weighing.

Weights for a shifted distribution help if a model is too small for the whole buffer (Shimodaira
2000), and have little effect if a network fits everything (Byrd and Lipton 2019). Errors are
measured on new episodes of the policy kept at a step. Runs must be whole, or small copies made with
--keep buffer policies.
"""

from argparse import ArgumentParser, Namespace
from collections.abc import Sequence
from math import exp, log, nan
from statistics import median

import numpy as np
from matplotlib.figure import Figure

from tom.errors import UserError, check_known
from tom.learners import SUBJECT
from tom.reports.figures import learner_colour, strips
from tom.studies.frozen import (
    ERROR,
    LABELS,
    MENDED,
    MODELS,
    PRINTED,
    ROLLOUT_ERROR,
    UNIFORM,
    WAYS,
)
from tom.studies.moments import (
    QUESTIONS,
    add_measure_options,
    against_intervals,
    answer_sentences,
    comparisons,
    findings,
    models_of,
    of_test,
    outcomes_of,
    ratios,
    way_point,
    with_interval,
    word_of_rows,
)
from tom.studies.study import Findings, Row
from tom.studies.verdicts import Tables, Verdict

TITLE = "Where weighting pays"
QUESTION = "Do TOM's weights make a model better where the policy goes, whatever its size?"
CLAIM = (
    "A model fitted by TOM's weights is accurate where the policy goes (figure 1). The paper "
    "never varies the model's capacity; its linear model of road-and-rocks is the small end."
)
ASKED = ("recency", "half-recency", "ratio", "tom-discounted", "tom-mended", "half-tom-mended")
AHEAD = {"one step": ERROR, "five steps": ROLLOUT_ERROR}
"""how far ahead an error is, and the beginning of its column"""


def add_options(parser: ArgumentParser) -> None:
    add_measure_options(parser, [UNIFORM, *ASKED], list(MODELS))


def find(args: Namespace) -> Findings:
    check_known("model", args.models, MODELS)
    outcomes = outcomes_of(args, args.models)
    if args.table and not any(ratios(outcomes, ERROR)):
        raise UserError(
            f"{args.table} has no moment with errors of models under both uniform and other "
            "weights, which are compared: name the moments.csv of another report"
        )
    rows, pairs = summary(outcomes), head_to_head(outcomes)
    figures = {
        name: (
            f"Error {ahead} ahead on new steps of the policy, over the error under uniform "
            "weights. One panel per model, one point per moment; the stroke is their median.",
            capacity_figure(outcomes, ahead),
        )
        for name, ahead in zip(("capacity", "capacity-rollouts"), AHEAD, strict=True)
    }
    tables = {"summary": rows, "head-to-head": pairs}
    return findings(args, in_sentences(rows, pairs), tables, outcomes, figures)


def summary(outcomes: Sequence[Row]) -> list[Row]:
    """One row for each way and model: the median ratio, its quartiles, how often it is below 1.

    Without those that share no moment and seed with uniform weights.
    """
    values: dict[tuple[str, str], dict[str, list[float]]] = {}
    for name, ahead in AHEAD.items():
        for one, model, ratio in ratios(outcomes, ahead):
            values.setdefault((one["way"], model), {}).setdefault(name, []).append(ratio)
    rows, ways = [], list(dict.fromkeys(one["way"] for one in outcomes))
    models = models_of(outcomes)
    for way, model in sorted(values, key=lambda pair: (ways.index(pair[0]), models.index(pair[1]))):
        row: Row = {"way": way, "model": model}
        for name, of in values[way, model].items():
            row |= {
                name: median(of),
                f"{name}, lower quartile": float(np.quantile(of, 0.25)),
                f"{name}, upper quartile": float(np.quantile(of, 0.75)),
                f"{name}, below 1": sum(ratio < 1 for ratio in of) / len(of),
            }
        rows.append(row | {"n": sum(one["way"] == way for one in outcomes)})
    return rows


def head_to_head(outcomes: Sequence[Row]) -> list[Row]:
    """One row per question of two ways and model: the ratio of their errors one step ahead.

    The ratio is the exponential of the mean difference of logarithms, and so are its interval and
    the ratio in each task.
    """
    rows, envs = [], {one["env"] for one in outcomes}
    for model in models_of(outcomes):
        column = ERROR + model

        def log_error(one: Row, column: str = column) -> float:
            return log(one[column]) if column in one else nan

        for row in comparisons(outcomes, log_error, "ratio", "less at", model=model):
            interval = np.exp([row["ratio"], row["low"], row["high"]]).tolist()
            row |= dict(zip(("ratio", "low", "high"), interval, strict=True))
            rows.append(row | {env: exp(row[env]) for env in row.keys() & envs})
    return sorted(rows, key=lambda row: list(QUESTIONS).index((row["way"], row["against"])))


def in_sentences(rows: Sequence[Row], pairs: Sequence[Row]) -> list[str]:
    """For each model the way with the lowest error, then the answers to questions of two ways."""
    sentences = []
    for model in dict.fromkeys(row["model"] for row in rows):
        here = [row for row in rows if row["model"] == model]
        best = min(here, key=lambda row: row["one step"])
        sentences.append(
            f"Model {model}: {best['way']} errs least, {best['one step']:.2f} of the error under "
            f"uniform weights one step ahead (less in {best['one step, below 1']:.0%} of "
            f"{best['n']} trials), {best['five steps']:.2f} five steps ahead."
        )
    return sentences + answer_sentences(pairs, "ratio", "less at")


def verdict(tables: Tables) -> Verdict:
    """By TOM's errors over those with uniform weights; without TOM, by every way's."""
    pairs = [row for row in tables["head-to-head"] if row["against"] == UNIFORM]
    table = [row for row in pairs if row["way"] in LABELS]
    of_tom = [row for row in table if row["way"] in (PRINTED, MENDED)]
    ours, whose = (of_tom, "TOM's") if of_tom else (table, "these")
    models = list(dict.fromkeys(row["model"] for row in ours))
    less = [m for m in models if all(row["high"] < 1 for row in ours if row["model"] == m)]
    cost = [
        f"{with_interval(row, 'ratio')} with {LABELS[row['way']]} ({of_test(row)})"
        for row in table
        if row["model"] == models[-1] and not WAYS[row["way"]].half
    ]
    sentence = (
        f"By their intervals, {whose} weights lower the model's error where the policy goes for "
        f"{' and '.join(less) or 'no model'} (units x layers). The error of {models[-1]} over that "
        f"with uniform weights is {' and '.join(cost)}."
    )
    points = [way_point(row, "ratio", row["model"], LABELS[row["way"]]) for row in table]
    axis = "model error (1: as with uniform weights)"
    question = ""
    if SUBJECT not in {point.learner for point in points}:
        ways = " and ".join(dict.fromkeys(point.series for point in points))
        question = QUESTION.replace("TOM's weights", f"the weights of {ways}")
    word = word_of_rows(ours)
    return Verdict(word, sentence, against_intervals(table), axis, 1, points, question=question)


def capacity_figure(outcomes: Sequence[Row], ahead: str) -> Figure:
    """Errors so far ahead of each way of weighing, a panel for each model."""
    points = [(model, one["way"], ratio) for one, model, ratio in ratios(outcomes, AHEAD[ahead])]
    colours = {name: learner_colour(way.learner or "") for name, way in WAYS.items()}
    what = f"error {ahead} ahead over that of uniform weights"
    return strips(colours, points, 1.0, what, [0.6, 0.8, 1, 1.25, 1.6, 2])
