"""Who learns fastest, and who ends highest? Return curves of the runs that the store has.

Compares learners at a step that all runs of an environment reach, or at one fixed beforehand, and
says if they were trained with different settings. Lists what is missing for the paper's figure.
Trains nothing: `tom sweep` makes the runs.
"""

from argparse import ArgumentParser, Namespace
from collections.abc import Iterator, Sequence
from math import isfinite
from typing import Any

from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import EngFormatter

from tom.analysis.curves import aggregate
from tom.analysis.scores import BEST, FINAL, HEIGHT
from tom.analysis.settings import differing_settings
from tom.analysis.statistics import RANKED, remark
from tom.envs import ENVS, task
from tom.errors import UserError
from tom.learners import LEARNERS, SUBJECT
from tom.record import Store
from tom.reports.figures import NEUTRAL, learner_colour, new_figure
from tom.reports.report import origin_of_runs
from tom.studies.frozen import LABELS, OF_TOM
from tom.studies.returns_cells import PAPER_ENVS, Cell, compared_at, select
from tom.studies.returns_tables import (
    MEASURES,
    exams,
    factors,
    improvement,
    less,
    missing,
    rollouts,
    summary,
)
from tom.studies.study import Findings, Row, add_groups, add_runs, check_groups, tasks
from tom.studies.verdicts import Point, Tables, Verdict, side, word_of

TITLE = "Returns of every learner"
QUESTION = "Do trainings with TOM's weights return more than MLE's?"
FACTORS_QUESTION = (
    "Do whole trainings return more with TOM's weights in the model, or in the starts?"
)
"""of runs with weights in the model, in the starts, in both and in none"""
CLAIM = (
    "TOM performs best in aggregate in four of five environments, in sample efficiency and in "
    "final return, with larger gains where dynamics are complex (Walker2d, HalfCheetah, Humanoid); "
    "4 seeds, running maximum of the mean of 10 test episodes (section 5.2)."
)
TITLES = {
    "summary": "Returns up to the step of the comparison; mean, median and IQM are of the best",
    "improvement": "How often a run of one learner beats one of another",
    "factors": "What weights in the model, and in the rollouts' starts, do for the return: each "
    "the mean over both levels of the other; p of all is corrected for the tests of this table",
    "exams": "Exams: the median fit of each run, on new steps of its own policy; mean over runs",
    "rollouts": "Rollouts: how often they fall over how often the policy does (median fit of each "
    "run), and the share of fits with a row that has a tenth of the weight; mean over runs",
    "less": "How often a run of one learner has a smaller number in its exams and rollouts than "
    "one of another (errors of runs on steps of their own policies)",
    "missing": "What is missing for the paper's figure",
}
BY = {"best": BEST, "last": FINAL, "area": HEIGHT}
CAPTION = "Best return so far: mean over seeds, 95 % bootstrap band, single seeds faint."
COLUMNS = 3
FEW_POINTS = 10
LONG = 26
"""letters of a name, of which two do not fit beside each other"""
LINES = ("-.", "--", ":", (0, (9, 2)), (0, (4, 1.5, 1, 1.5, 1, 1.5)))
"""of a learner's variants"""


def add_options(parser: ArgumentParser) -> None:
    add_runs(parser, ENVS, "[all of ours]")
    add_groups(parser)
    parser.add_argument(
        "--at", nargs="+", default=[], metavar="[ENV=]STEP",
        help="compare at this env step (in ENV only, if it is named), without runs that end "
        "earlier [the step that all runs reach]",
    )  # fmt: skip
    parser.add_argument("--seeds", nargs="+", type="seed", metavar="N", help="[all]")
    parser.add_argument(
        "--apart", action="store_true",
        help="count runs with settings other than their preset's as learners of their own [only "
        "the settings that most seeds of a learner and preset share]",
    )  # fmt: skip
    parser.add_argument(
        "--groups", nargs="+", metavar="GROUP",
        help='compare only these, named as in the tables (MLE, "TOM, mended") [all]',
    )  # fmt: skip
    parser.add_argument(
        "--by", nargs="+", choices=tuple(BY), default=list(BY), metavar="SCORE",
        help=f"compare only by these, of {' '.join(BY)}; p is corrected for no others [all]",
    )  # fmt: skip


def find(args: Namespace) -> Findings:
    check_groups(args)
    envs, planned = tasks(args.env), args.groups is not None
    whole, cells, left_out = _chosen(args, envs)
    by = [BY[name] for name in args.by]
    sentences = in_sentences(cells)
    if left_out:
        sentences.append(
            "Left out, for other settings, a longer run of the seed, no evaluation, a first one "
            f"after the others' end, or an end before --at: {', '.join(left_out)}."
        )
    return Findings(
        sentences=sentences,
        files={
            "returns": _curves(cells),
            "summary": summary(cells),
            "improvement": improvement(cells, by, planned=planned),
            "factors": factors(cells, by),
            "exams": exams(cells),
            "rollouts": rollouts(cells),
            "less": less(cells, planned=planned),
            "missing": missing(whole, envs, args.learner),
        },
        titles=TITLES,
        figures={"returns": (CAPTION, return_figure(cells))},
        origin=origin_of_runs([run for cell in cells for run in cell.runs]),
    )


def _chosen(args: Namespace, envs: Sequence[str]) -> tuple[list[Cell], list[Cell], list[str]]:
    """The cells of all seeds and steps, those that are compared, and the runs that are left out.

    Raises UserError if nothing is left to compare, or not all of a planned comparison: it is made
    whole or not at all, because p is corrected for what was planned.
    """
    at, usual = _steps(args.at, envs), args.preset[0]
    runs = [
        run for run in Store(args.store).runs() if run.env in envs and run.learner in args.learner
    ]
    whole, _ = select(runs, *args.preset, apart=args.apart)
    if not whole:
        raise UserError(
            f"{args.store}/ has no such run with an evaluation: tom sweep --env {' '.join(envs)} "
            f"--learner {' '.join(args.learner)} --preset {usual} "
            f"--seeds {' '.join(map(str, range(RANKED)))} makes them"
        )
    runs = [run for run in runs if args.seeds is None or run.seed in args.seeds]
    # In the tables a group's name leaves the first preset out; Curves names every one.
    groups = args.groups and [
        ", ".join(word for word in group.split(", ") if word != usual) for group in args.groups
    ]
    cells, left_out = select(runs, *args.preset, at=at, apart=args.apart, groups=groups)
    left = {cell.label for cell in cells}
    if not cells or {*(groups or ())} - left:
        asked = {"--at": args.at, "--seeds": args.seeds, "--groups": groups}
        words = (f"{option} {' '.join(map(str, of))}" for option, of in asked.items() if of)
        every = "; ".join(sorted({cell.label for cell in whole}))
        raise UserError(
            f"{' '.join(words)}: {'; '.join(sorted(left)) or 'nobody'} can be compared there, of "
            f"{every}; the longest run of all ends at {max(cell.longest for cell in whole):.0f}"
        )
    return whole, cells, left_out


def _steps(words: Sequence[str], envs: Sequence[str]) -> dict[str, int]:
    """The step of each environment that has one, from `STEP` (of all) or `ENV=STEP`."""
    at: dict[str, int] = {}
    for word in sorted(words, key=lambda word: "=" in word):
        env, named, digits = word.rpartition("=")
        if not (digits.isdecimal() and int(digits)):
            raise UserError(f"--at must be at least 1, or ENV=STEP, not '{word}'")
        if not named and at:
            raise UserError("--at takes one step of all, and one ENV=STEP for each other")
        if named and task(env).name not in envs:
            raise UserError(f"--at {word}: --env does not name {env}")
        at |= dict.fromkeys([task(env).name] if named else envs, int(digits))
    return at


def _curves(cells: Sequence[Cell]) -> Iterator[Row]:
    for cell in cells:
        for curve in cell.curves:
            of = {"env": cell.env, "learner": cell.label, "seed": curve.seed, "run": curve.run_id}
            points = zip(curve.step, curve.value, curve.best_so_far.value, strict=True)
            for step, value, best in points:
                yield {**of, "step": int(step), "return": value, "best": best}


def in_sentences(cells: Sequence[Cell]) -> list[str]:
    """TOM's place among the groups with enough runs to be ranked, and the reservations."""
    of_paper = [c for c in cells if c.env in PAPER_ENVS]
    sentences = _places([c for c in of_paper if c.n >= RANKED])
    if few := [f"{c.env}: {c.label} (n = {c.n})" for c in of_paper if c.n < RANKED]:
        sentences.append(f"Not ranked, with fewer than {RANKED} runs: {'; '.join(few)}.")
    for env, step in compared_at(cells).items():
        here = [c for c in cells if c.env == env]
        if (longest := max(cell.longest for cell in here)) > step:
            sentences.append(
                f"{env}: compared at step {step:.0f} of {longest:.0f}, the last that all runs "
                "reach."
            )
        if paths := differing_settings([run for cell in here for run in cell.runs]):
            sentences.append(
                f"{env}: the learners' runs differ in more than learner, seed and steps "
                f"({', '.join(paths)}), so returns may differ by these settings."
            )
    return sentences


def _places(ranked: Sequence[Cell]) -> list[str]:
    """Where TOM and its variants have the highest mean, each without the others as rivals.

    Only environments count that have TOM, of the first preset, and another learner.
    """
    toms = {c.env for c in ranked if c.learner == "tom" and not c.variant}
    judged = toms & {c.env for c in ranked if c.learner != "tom"}
    every = [c for c in ranked if c.env in judged]
    if not judged:
        return [
            f"No environment of the paper has at least {RANKED} runs of TOM, of the first preset, "
            "and of another learner: nothing to compare with the claim."
        ]
    best = {
        env: max(c.scores().mean() for c in every if c.env == env and c.learner != "tom")
        for env in judged
    }
    sentences = []
    for label in dict.fromkeys(c.label for c in every if c.learner == "tom"):
        own = [c for c in every if c.label == label]
        first = [c.env for c in own if c.scores().mean() > best[c.env]]
        where = f" ({', '.join(first)})" if first else ""
        sentences.append(
            f"{label} has the highest mean in {len(first)} of {len(own)} of the paper's "
            f"environments{where}; the paper says 4 of 5."
        )
    if few := remark([c.n for c in every]):
        sentences.append(f"The smallest group: {few}.")
    short = [
        f"{env} {step:.0f} of {task(env).steps}"
        for env, step in compared_at(every).items()
        if step < task(env).steps
    ]
    if short:
        sentences.append(
            f"Compared before the end of the paper's training: {'; '.join(short)} steps."
        )
    return sentences


def verdict(tables: Tables) -> Verdict:
    """By the effect of each place where weights act, if it is known; else by wins over MLE."""
    if "factors" in tables:
        return _of_factors(tables["factors"])
    return _of_wins(tables["improvement"])


def _of_wins(rows: Sequence[Row]) -> Verdict:
    """By the p of all of TOM's comparisons with MLE."""
    learners = {entry.label: name for name, entry in LEARNERS.items()}
    learners |= dict.fromkeys(OF_TOM, SUBJECT)
    table = [row for row in rows if row["against"] == "MLE" and row["learner"] in learners]
    shown = {label: label for label in learners} | {of: LABELS[way] for of, way in OF_TOM.items()}
    ours = [row for row in table if row["learner"] in OF_TOM]
    sides = [side(row["p of all"], row["wins"] > 0.5) for row in ours]
    chances = [
        f"{shown[row['learner']]} {10 * row['wins']:.0f} times in 10 (p {row['p']:.2g})"
        for row in ours
        if row["by"] == MEASURES[BEST]
    ]
    sentence = f"By best return, a random run beats a random run of MLE: {', '.join(chances)}."
    least = min(row["p of all"] for row in ours)
    remarks = (row["remark"] for row in ours if isinstance(row["remark"], str))
    few = next((f" {one[0].upper()}{one[1:]}." for one in remarks), "")
    against = f"Corrected for all comparisons of the table, the smallest p is {least:.2g}.{few}"
    points = [
        Point(
            row["by"], shown[name := row["learner"]], row["wins"], row["low"], row["high"],
            learners[name], OF_TOM.get(name, ""),
        )
        for row in table
    ]  # fmt: skip
    axis = "a random run beats one of MLE"
    return Verdict(word_of(sides), sentence, against, axis, 0.5, points)


def _of_factors(table: Sequence[Row]) -> Verdict:
    """By the mean height of the curves, the p corrected for all tests of the table."""
    tested = [row for row in table if isfinite(row["p"])]
    rows = [row for row in tested if row["by"] == MEASURES[HEIGHT]]
    found = [
        f"{row['effect of']} {row['effect']:+.0f} ({row['low']:+.0f} to {row['high']:+.0f}, "
        f"p {row['p']:.2g})"
        for row in rows
    ]
    sentence = f"Mean return over a training: {', '.join(found)}."
    few = next((f"; {row['remark']}" for row in rows if isinstance(row["remark"], str)), "")
    p = ", ".join(f"{row['p of all']:.2g}" for row in rows)
    against = f"Corrected for all {len(tested)} tests of the table, p is {p}. One task{few}."
    points = [
        Point(row["effect of"], "", row["effect"], row["low"], row["high"], SUBJECT) for row in rows
    ]
    sides = [side(row["p of all"], row["effect"] > 0) for row in rows]
    word, question = word_of(sides), FACTORS_QUESTION
    return Verdict(word, sentence, against, "return more", 0, points, question=question)


def return_figure(cells: Sequence[Cell]) -> Figure:
    """The best return so far, one panel per environment.

    A dotted line marks the step at which learners are compared.
    """
    at = compared_at(cells)
    rows = -(-len(at) // COLUMNS)
    columns = -(-len(at) // rows)  # four panels are two by two
    figure = new_figure(3.6 * columns + 0.4, 3.4 * rows + 0.2)
    axes = figure.subplots(rows, columns, squeeze=False).ravel()
    variants: dict[str, list[str]] = {}  # of each learner: they differ in their lines
    for learner, variant in sorted({(c.learner, c.variant) for c in cells}):
        variants.setdefault(learner, []).append(variant)
    for ax, env in zip(axes, at, strict=False):
        for cell in (c for c in cells if c.env == env):
            before = variants[cell.learner].index(cell.variant)
            _draw(ax, cell, LINES[before % len(LINES)] if cell.variant else "-")
        ax.axvline(at[env], color=NEUTRAL, linestyle=":", linewidth=0.9)
        ax.set_title(env)
        ax.set_xlabel("env steps")
        ax.xaxis.set_major_formatter(EngFormatter(sep=""))  # 40k
        names = ax.get_legend_handles_labels()[1]
        ncols = 2 if max(map(len, names)) <= LONG else 1
        below = {"loc": "upper center", "bbox_to_anchor": (0.5, -0.2)}
        ax.legend(fontsize=7.5, ncols=ncols, handlelength=3.2, **below)
    for ax in axes[len(at) :]:
        ax.set_visible(False)
    axes[0].set_ylabel("best return so far")
    return figure


def _draw(ax: Axes, cell: Cell, line: Any) -> None:
    colour = learner_colour(cell.learner)
    group = aggregate([curve.best_so_far for curve in cell.curves])
    for curve in group.curves:
        ax.plot(curve.step, curve.value, color=colour, alpha=0.3, linewidth=0.7)
    whole = group.complete
    steps = group.step[whole]
    marker = "o" if len(steps) < FEW_POINTS else None  # a line needs two points
    style = {"linestyle": line, "color": colour, "marker": marker, "markersize": 3}
    ax.plot(steps, group.mean[whole], label=f"{cell.label} (n = {cell.n})", **style)
    if cell.n > 1 and len(steps):
        low, high = group.low[whole], group.high[whole]
        ax.fill_between(steps, low, high, color=colour, alpha=0.15, linewidth=0)
