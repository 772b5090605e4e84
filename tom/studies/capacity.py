"""For which models does weighting pay? Models of growing capacity, fitted by every way of weighing.

Weights for a shifted distribution help if a model is too small for the whole buffer (Shimodaira
2000), and have little effect if a network fits everything (Byrd and Lipton 2019). Errors are those
on episodes that the kept policy of a step makes anew. Runs must be whole, or small copies made with
--keep buffer policies.
"""

from argparse import ArgumentParser, Namespace
from collections.abc import Sequence
from functools import partial
from math import exp, log, nan
from statistics import median

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from tom.errors import UserError
from tom.reports.figures import NEUTRAL, learner_colour, log_ticks, new_figure
from tom.studies.frozen import ERROR, MODELS, ROLLOUT_ERROR, UNIFORM, WAYS
from tom.studies.moments import (
    QUESTIONS,
    add_measuring,
    comparisons,
    findings,
    measured,
    models_of,
    ratios,
    spanned,
)
from tom.studies.study import Findings, Lab, Row, Study, check_known

ASKED = ("recency", "half-recency", "ratio", "tom-discounted", "tom-mended", "half-tom-mended")
AHEAD = {"one step": ERROR, "five steps": ROLLOUT_ERROR}
"""how far ahead an error is, and the beginning of its column"""
CAPTION = (
    "Error on new steps of the policy over the error under uniform weights, median over moments; "
    "bars hold their middle half."
)
LINES = ("-", "--", ":", "-.")
SPREAD = 0.09  # between the ways at one model


def add_options(parser: ArgumentParser) -> None:
    add_measuring(parser, [UNIFORM, *ASKED], list(MODELS))


def find(args: Namespace, lab: Lab) -> Findings:
    check_known("model", args.models, MODELS)
    outcomes = measured(args, lab, args.models)
    if args.table and not any(ratios(outcomes, ERROR)):
        raise UserError(
            f"{args.table} has no moment with both uniform and other weights, "
            "whose errors are compared: name the moments.csv of another report"
        )
    rows, pairs = summary(outcomes), head_to_head(outcomes)
    figure = CAPTION, partial(capacity_figure, outcomes)
    return findings(args, "capacity", verdict(rows, pairs), rows, outcomes, figure, pairs=pairs)


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


def verdict(rows: Sequence[Row], pairs: Sequence[Row]) -> list[str]:
    """For each model the way with the lowest error, then the answers to questions of two ways."""
    said = []
    for model in dict.fromkeys(row["model"] for row in rows):
        here = sorted((r for r in rows if r["model"] == model), key=lambda row: row["one step"])
        best, most = here[0], here[-1]
        said.append(
            f"Model {model}: {best['way']} errs least, {best['one step']:.2f} of the error under "
            f"uniform weights one step ahead (middle half of the moments "
            f"{best['one step, lower quartile']:.2f} to {best['one step, upper quartile']:.2f}, "
            f"less in {best['one step, below 1']:.0%} of {best['n']}), {best['five steps']:.2f} "
            f"five steps ahead; most under {most['way']}, {most['one step']:.2f}."
        )
    for (way, against), question in QUESTIONS.items():
        told = [
            f"{row['model']} {spanned(row, 'ratio')} "
            f"(less at {row['less at']} of {row['n']}, p = {row['p']:.2f})"
            for row in pairs
            if (row["way"], row["against"]) == (way, against)
        ]
        if told:
            said.append(f"{question} {way}'s error over {against}'s: {'; '.join(told)}.")
    return said


def capacity_figure(outcomes: Sequence[Row]) -> Figure:
    """Errors one step and five steps ahead, against the capacity of the model."""
    figure = new_figure(9.0, 3.4)
    axes = figure.subplots(1, len(AHEAD), sharey=True)
    for ax, (name, ahead) in zip(axes, AHEAD.items(), strict=True):
        _draw(ax, [(one["way"], model, ratio) for one, model, ratio in ratios(outcomes, ahead)])
        ax.set_title(f"{name} ahead")
    axes[0].set_ylabel("error over that of uniform weights")
    axes[-1].legend(loc="upper left", bbox_to_anchor=(1.0, 1.0))
    return figure


def _draw(ax: Axes, values: Sequence[tuple[str, str, float]]) -> None:
    models = [model for model in MODELS if any(m == model for _, m, _ in values)]
    ways = [way for way in WAYS if any(w == way for w, _, _ in values)]
    drawn: dict[str, int] = {}  # lines of each learner so far
    ax.axhline(1.0, color=NEUTRAL, linewidth=0.8)
    for number, way in enumerate(ways):
        of = [[r for w, m, r in values if (w, m) == (way, model)] for model in models]
        low, middle, high = np.array([np.quantile(group, (0.25, 0.5, 0.75)) for group in of]).T
        learner = WAYS[way].learner or ""
        ax.errorbar(
            np.arange(len(models)) + SPREAD * (number - (len(ways) - 1) / 2),
            middle,
            yerr=(middle - low, high - middle),
            color=learner_colour(learner),
            linestyle=LINES[drawn.setdefault(learner, 0) % len(LINES)],
            marker="o",
            markersize=4,
            elinewidth=0.8,
            label=way,
        )
        drawn[learner] += 1
    ax.set_yscale("log")
    log_ticks(ax.yaxis, [0.5, 0.6, 0.7, 0.8, 0.9, 1, 1.1, 1.25, 1.5])
    ax.set_xticks(range(len(models)), models)
    ax.set_xlabel("model (units x layers)")


STUDY = Study(
    "capacity",
    "Where weighting pays",
    __doc__,
    "A model fitted by TOM's weights is accurate where the policy goes (figure 1). The paper "
    "varies the model's capacity nowhere; its linear model of road-and-rocks is the small end.",
    add_options,
    find,
)
