"""`tom reproduce improvement`: what weights do for the policy, on the same frozen buffers."""

import argparse
from dataclasses import asdict
from typing import Any

from tom.cli.named import TERMINATION
from tom.cli.parser import DEST
from tom.cli.reproduce.frozen import add_moments, check_model, chosen_runs, chosen_ways
from tom.cli.reproduce.study import (
    add_output,
    check_seeds,
    out_folder,
    print_json,
    say,
    stoppable,
)
from tom.cli.tables import cell, show
from tom.envs import task
from tom.envs.ends import rule
from tom.errors import UserError
from tom.record import RunReader
from tom.reports.files import write_csv
from tom.reports.html import Report, write_report
from tom.reports.origin import seeds as in_short
from tom.reports.style import save
from tom.studies import improvement as study
from tom.studies import improvement_summary as results
from tom.studies.each import each
from tom.studies.frozen import MODELS, cases
from tom.studies.improvement_figure import improvement_figure
from tom.studies.report import study_origin

TITLE = "What weighting does for the policy"
WAYS = ("uniform", "tom-mended")
CLAIM = (
    "Policies that are optimised in a model fitted by TOM's weights, from start states drawn by "
    "them, earn higher returns (section 5.2). The paper compares whole runs, and never one of the "
    "two places without the other."
)
CAPTION = (
    "Mean-action return while SAC is updated in the model (mean of five evaluations), less that "
    "with uniform weights at the same moment and seed, one point each; the stroke is their median. "
    "Linear within 100, logarithmic beyond."
)


def add_parser(subparsers, arguments: list[str]) -> None:
    parser = subparsers.add_parser(
        "improvement",
        help="what weights in the model, and in the rollouts' starts, do for the policy",
        description="Take the replay buffers of runs and of recordings of SAC as they stood at "
        "steps whose policy was kept. Fit a model to each by every way of weighing, go on with the "
        "stored policy and critics on rollouts in it, and compare the returns: weights in the "
        "model alone, in the rollouts' start states alone, in both, in neither. Runs must be "
        "whole, or small copies made with --keep buffer policies.",
    )
    add_moments(parser, WAYS)
    parser.add_argument(
        "--termination", dest=DEST + TERMINATION, metavar="module:function",
        help="the rule that runs were trained with, if it is code of yours; it is used for these",
    )  # fmt: skip
    known = ", ".join(f"'{name}'" for name in MODELS)
    parser.add_argument("--model", default="200 x 4", help=f"{known} [%(default)s]")
    parser.add_argument(
        "--updates", type=int, default=1250, help="of SAC, those between two fits [1250]"
    )
    parser.add_argument("--episodes", type=int, default=5, help="of an evaluation [5]")
    add_output(parser, "improvement")
    parser.set_defaults(run=run)


@stoppable
def run(args: argparse.Namespace) -> int:
    check_seeds(args.jobs, args.seeds)
    check_model(args.model)
    if args.updates < study.PARTS or args.episodes < 1:
        raise UserError(f"--updates must be at least {study.PARTS} and --episodes at least 1")
    runs, ways = _runs(args), chosen_ways(args)
    out_folder(args.out)
    found: list[study.Improvement] = []
    asked = cases(runs, ways, args.seeds, args.moments, (args.model,))
    trials = [study.Trial(case, args.updates, args.episodes) for case in asked]
    for one in each(study.improved, trials, args.jobs, args.out):
        found.append(one)
        say(f"{len(found)} of {len(trials)}: {one.recording} at {one.step}: {one.way}")
    rows, said = _write(args, found, runs)
    if args.json:
        print_json({"summary": rows, "verdict": said, "out": str(args.out)})
        return 0
    show(TITLE, tuple(rows[0]), [tuple(map(cell, row.values())) for row in rows])
    print("\n".join([*said, str(args.out)]))
    return 0


def _runs(args: argparse.Namespace) -> list[RunReader]:
    """The runs with moments from which SAC can go on.

    Raises UserError if there are none, or the rule that ended a run's modelled episodes is unknown.
    """
    runs = chosen_runs(args)
    able = [run for run in runs if study.goes_on(run)]
    if not able or (args.runs and len(able) < len(runs)):
        lacking = next(run.run_id for run in runs if run not in able)
        raise UserError(f"run {lacking} kept no critics with its policies: name others")
    given, known = getattr(args, DEST + TERMINATION), {study.rule_of(run) for run in able}
    if given is not None and given not in known:
        raise UserError(f"--termination {given}: no run here was trained with it, leave it out")
    for run in able:
        rule(task(run.env), study.rule_of(run))
    return able


def _write(
    args: argparse.Namespace, found: list[study.Improvement], runs: list[RunReader]
) -> tuple[list[dict[str, Any]], list[str]]:
    """Write the report; returns its table and its verdict."""
    rows, said = results.summary(found), results.verdict(found)
    write_csv(args.out / "summary.csv", rows)
    write_csv(args.out / "moments.csv", [asdict(one) for one in found])
    png, _ = save(improvement_figure(found), args.out, "improvement")
    n = f"{len({(one.recording, one.step) for one in found})} moments of {len(runs)} runs"
    made = study_origin(n=n, seeds=in_short(args.seeds), runs=", ".join(r.run_id for r in runs))
    tables = [("Against uniform weights", rows)]
    write_report(Report(TITLE, CLAIM, said, [(CAPTION, png)], tables, made), args.out)
    return rows, said
