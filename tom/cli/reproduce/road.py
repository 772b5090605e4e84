"""`tom reproduce road`: where TOM drives and MLE does not, with controls and the sweep."""

import argparse
from collections.abc import Sequence
from dataclasses import asdict
from math import isnan
from pathlib import Path

from tom.cli.reproduce.study import (
    Distinct,
    add_jobs,
    add_output,
    check_seeds,
    out_folder,
    print_json,
    say,
    show_checks,
    stoppable,
)
from tom.cli.tables import show
from tom.config import RoadConfig
from tom.reports.files import write_csv
from tom.reports.origin import seeds as in_short
from tom.reports.style import save
from tom.road.offline_data import map_of
from tom.studies import road_figure as figures
from tom.studies import road_map as maps
from tom.studies import verdicts
from tom.studies.checks import Check
from tom.studies.each import each
from tom.studies.report import write_study
from tom.studies.road import (
    Outcome,
    Story,
    acceptance,
    acceptance_cases,
    baseline_cases,
    control_cases,
    controls,
    sweep_cases,
    tell,
)

CLAIM = (
    "On road-and-rocks TOM substantially outperforms offline MBPO, and does so because it gives "
    "the controllable region, the road, the higher weights (section 5.1)."
)

ENVIRONMENT = "The task: road (green), rocks, start and goal; arrows are what the action right does"


def add_parser(subparsers, arguments: list[str]) -> None:
    parser = subparsers.add_parser(
        "road",
        help="road-and-rocks: TOM beside MLE and PMAC, controls, baselines, the sweep over turn",
        description="Train road-and-rocks over seeds and hold the outcome against the acceptance; "
        "controls that must fail, simpler baselines, and the sweep that says where the claim "
        "holds. Writes figures (PNG, SVG) and the numbers behind them (CSV).",
    )
    parser.add_argument(
        "--seeds", nargs="+", type=int, action=Distinct, default=list(range(8)), help="[0 .. 7]"
    )
    parser.add_argument(
        "--sweep-seeds",
        nargs="+",
        type=int,
        action=Distinct,
        default=[4, 5],
        help="seeds of the sweep [4 5]",
    )
    add_jobs(parser)
    add_output(parser, "road")
    parser.set_defaults(run=run)


@stoppable
def run(args: argparse.Namespace) -> int:
    check_seeds(args.jobs, [*args.seeds, *args.sweep_seeds])
    out_folder(args.out)
    main = [*acceptance_cases(args.seeds), *control_cases(args.seeds), *baseline_cases(args.seeds)]
    asked = [*main, *sweep_cases(args.sweep_seeds)]
    told: list[Story] = []
    for story in each(tell, asked, args.jobs, args.out):
        told.append(story)
        say(f"{story.outcome.name} seed {story.outcome.seed} turn {story.outcome.turn:g}")
    stories, sweep = told[: len(main)], [story.outcome for story in told[len(main) :]]
    outcomes = [s.outcome for s in stories]
    checks = [*acceptance(outcomes), *controls(outcomes)]
    said = verdicts.road(outcomes, sweep)
    _write(args.out, stories, sweep, checks, said)
    _print(checks, outcomes, said, args)
    return 0 if all(check.met for check in checks) else 1


def _write(
    out: Path,
    stories: Sequence[Story],
    sweep: Sequence[Outcome],
    checks: Sequence[Check],
    said: Sequence[str],
) -> None:
    write_csv(out / "outcomes.csv", (asdict(s.outcome) for s in stories))
    write_csv(out / "sweep.csv", (asdict(o) for o in sweep))
    write_csv(out / "checks.csv", (asdict(c) for c in checks))
    curves = (
        {"name": s.outcome.name, "seed": s.outcome.seed, "step": step, "return": value}
        for s in stories
        for step, value in s.returns
    )
    write_csv(out / "returns.csv", curves)
    first = map_of(RoadConfig(learner="tom", seed=min(s.outcome.seed for s in stories)))
    write_csv(out / "environment.csv", maps.environment_rows(first))
    write_csv(out / "weights.csv", maps.weight_rows(stories))
    drawn = {
        ENVIRONMENT: (maps.environment_figure(first), "environment"),
        "Return in the real task, single seeds faint": (figures.return_figure(stories), "returns"),
        "The planner's return as the rocks turn more": (figures.sweep_figure(sweep), "sweep"),
    }
    if any(s.weights is not None for s in stories):
        drawn["Mean weight over the map"] = (maps.weight_figure(stories), "weights")
    pngs = [(caption, save(figure, out, name)[0]) for caption, (figure, name) in drawn.items()]
    rows = [asdict(c) for c in checks]
    outcomes = [("By seed", [asdict(s.outcome) for s in stories])]
    used = in_short([s.outcome.seed for s in stories])
    learners = len({s.outcome.name for s in stories})
    n = f"{len(stories)} trainings of {learners} learners and controls"
    write_study(out, "Road-and-rocks", CLAIM, said, rows, pngs, outcomes, n=n, seeds=used)


def _print(
    checks: Sequence[Check],
    outcomes: Sequence[Outcome],
    said: Sequence[str],
    args: argparse.Namespace,
) -> None:
    if args.json:
        judged = [asdict(c) for c in checks]
        print_json({"checks": judged, "verdict": said, "out": str(args.out)})
        return
    title = f"Road-and-rocks, seeds {' '.join(map(str, args.seeds))}"
    show_checks(title, checks)
    _show_seeds(outcomes)
    print("\n".join([*said, str(args.out)]))


def _show_seeds(outcomes: Sequence[Outcome]) -> None:
    """Print the returns and successes of every case for each seed."""
    rows = [
        (
            o.name,
            str(o.seed),
            _cell(o.road_ratio, 1),
            _cell(o.road_share, 2),
            _cell(o.sac_return, 1),
            _cell(o.sac_success, 2),
            _cell(o.planner_return, 1),
            _cell(o.planner_success, 2),
        )
        for o in sorted(outcomes, key=lambda o: (o.name, o.seed))
    ]
    columns = ("case", "seed", "ratio", "share", "SAC", "success", "planner", "success")
    show("By seed: return and success of SAC in the model, and of the planner", columns, rows)


def _cell(value: float, digits: int) -> str:
    """A number, or a dash if it was not measured."""
    return "-" if isnan(value) else f"{value:.{digits}f}"
