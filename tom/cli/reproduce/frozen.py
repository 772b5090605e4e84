"""`tom reproduce footprint` and `capacity`: all ways of weighing on the same frozen buffers.

The options of moments are also those of `tom reproduce improvement`.
"""

import argparse
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from matplotlib.figure import Figure

from tom.cli.reproduce.study import (
    add_jobs,
    add_output,
    add_store,
    check_seeds,
    out_folder,
    print_json,
    say,
    stoppable,
)
from tom.cli.tables import cell, show
from tom.envs import ENVS, ROAD, task, task_rank
from tom.errors import UserError, unknown
from tom.record import RunReader, Store
from tom.reports.files import write_csv
from tom.reports.html import Report, write_report
from tom.reports.origin import seeds as in_short
from tom.reports.style import save
from tom.studies import capacity, footprint
from tom.studies.capacity_figure import capacity_figure
from tom.studies.each import each
from tom.studies.footprint_figure import footprint_figure
from tom.studies.frozen import MODELS, NEWEST, WAYS, Outcome, cases, examined, moments
from tom.studies.frozen_table import read_outcomes, write_outcomes
from tom.studies.report import study_origin

OF_MEASURING = ("env", "moments", "seeds", "ways", "store", "jobs", "rows", "models")
"""the options that say what is measured and how"""
MEASURED = "measured: "
"""begins what a report that was made anew says of the origin of its outcomes"""


@dataclass(frozen=True)
class FrozenStudy:
    """The differences between the two studies."""

    name: str
    title: str
    help: str
    claim: str
    caption: str
    ways: tuple[str, ...]
    models: tuple[str, ...]
    figure: Callable[[Sequence[Outcome]], Figure]
    summary: Callable[[Sequence[Outcome]], list[dict[str, Any]]]
    head_to_head: Callable[[Sequence[Outcome]], list[dict[str, Any]]]
    verdict: Callable[[Sequence[Outcome]], list[str]]


FOOTPRINT = FrozenStudy(
    "footprint",
    "Where the weights lie",
    "how near each way of weighing brings a buffer to what the policy does",
    "TOM weighs the replay buffer so that its distribution of transitions matches that of the "
    "current policy (section 4). The paper measures the match on road-and-rocks alone.",
    "Energy distance of (s, a, s' - s), z-scored, between the weighted buffer and fresh episodes "
    "of the policy, over that of the unweighted buffer (1: no better than no weights). A point a "
    "moment of a run, the stroke is their median; points below 0.03 are drawn there. Moments whose "
    "distances are lost in noise are left out.",
    tuple(WAYS),
    (),
    footprint_figure,
    footprint.summary,
    footprint.head_to_head,
    footprint.verdict,
)
CAPACITY = FrozenStudy(
    "capacity",
    "Where weighting pays",
    "error of models of growing capacity, fitted by each way of weighing",
    "A model fitted by TOM's weights is accurate where the policy goes (figure 1). The paper "
    "varies the model's capacity nowhere; its linear model of road-and-rocks is the small end.",
    "Error on new steps of the policy over the error under uniform weights, median over moments; "
    "bars hold their middle half.",
    ("uniform", "recency", "half-recency", "ratio", "tom-discounted", "tom-mended",
     "half-tom-mended"),
    tuple(MODELS),
    capacity_figure,
    capacity.summary,
    capacity.head_to_head,
    capacity.verdict,
)  # fmt: skip


def add_parser(subparsers, arguments: list[str]) -> None:
    for study in (FOOTPRINT, CAPACITY):
        parser = subparsers.add_parser(
            study.name,
            help=study.help,
            description="Take the replay buffers of runs and of recordings of SAC as they stood "
            "at steps whose policy was kept, weigh each by every way, and judge the result by "
            f"episodes that the policy of that step makes anew: {study.help}. Runs must be whole, "
            "or small copies made with --keep buffer policies.",
        )
        add_moments(parser, study.ways)
        parser.add_argument("--rows", type=int, default=6000, help="new transitions [6000]")
        if study.models:
            known = ", ".join(f"'{name}'" for name in MODELS)
            parser.add_argument("--models", nargs="+", default=study.models, help=f"[{known}]")
        parser.add_argument(
            "--from", dest="table", type=Path, metavar="FILE",
            help="moments.csv of an earlier report: only its tables and figures are made anew",
        )  # fmt: skip
        add_output(parser, study.name)
        usual = {name: parser.get_default(name) for name in OF_MEASURING}
        parser.set_defaults(run=stoppable(_command(study, usual)))


def add_moments(parser: argparse.ArgumentParser, ways: Sequence[str]) -> None:
    """Add the options that choose runs, their moments, and ways of weighing."""
    parser.add_argument("runs", nargs="*", metavar="RUN", help="[all of the store that can]")
    parser.add_argument("--env", nargs="+", default=list(ENVS), metavar="ENV", help="[all of ours]")
    parser.add_argument("--moments", type=int, default=8, help="of each run at most [8]")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0], help="[0]")
    parser.add_argument(
        "--ways", nargs="+", default=list(ways), metavar="WAY", help=", ".join(WAYS)
    )
    add_store(parser)
    add_jobs(parser)


def _command(study: FrozenStudy, usual: Mapping[str, Any]) -> Callable[[argparse.Namespace], int]:
    """The command of a study; `usual` are the defaults of the options OF_MEASURING."""

    def run(args: argparse.Namespace) -> int:
        if args.table:
            given = [name for name in usual if getattr(args, name, None) != usual[name]]
            _refuse_beside_a_table(given, args.runs)
        models = dict.fromkeys(getattr(args, "models", study.models))
        for name in models:
            check_model(name)
        return _run(replace(study, ways=tuple(chosen_ways(args)), models=tuple(models)), args)

    return run


def _refuse_beside_a_table(given: Sequence[str], runs: Sequence[str]) -> None:
    """Raises UserError for options that have no meaning if nothing is measured."""
    if too_many := [*(f"--{option}" for option in given), *runs]:
        raise UserError(
            "--from takes all that its file holds, as it was measured: leave out "
            f"{' '.join(too_many)}"
        )


def _run(study: FrozenStudy, args: argparse.Namespace) -> int:
    outcomes = _kept(study, args) if args.table else _measured(study, args)
    rows, said = _write(study, args, outcomes)
    if args.json:
        print_json({"summary": rows, "verdict": said, "out": str(args.out)})
        return 0
    if rows:
        show(study.title, tuple(rows[0]), [tuple(map(cell, row.values())) for row in rows])
    print("\n".join([*said, str(args.out)]))
    return 0


def _measured(study: FrozenStudy, args: argparse.Namespace) -> list[Outcome]:
    """The outcomes of all cases."""
    check_seeds(args.jobs, args.seeds)
    if args.rows < 100:
        raise UserError("--rows must be at least 100")
    runs = chosen_runs(args)
    out_folder(args.out)
    outcomes: list[Outcome] = []
    asked = cases(runs, study.ways, args.seeds, args.moments, study.models, args.rows)
    for one in each(examined, asked, args.jobs, args.out):
        outcomes.append(one)
        say(f"{len(outcomes)} of {len(asked)}: {one.recording} at {one.step}: {one.way}")
    return outcomes


def _kept(study: FrozenStudy, args: argparse.Namespace) -> list[Outcome]:
    """The outcomes of an earlier report."""
    outcomes = read_outcomes(args.table, bool(study.models))
    if study.models and not any(capacity.ratios(outcomes, "error")):
        raise UserError(
            f"{args.table} has no moment with both uniform and other weights, whose errors are "
            "compared: name the moments.csv of another report"
        )
    out_folder(args.out)
    return outcomes


def _measurement(table: Path) -> dict[str, str]:
    """How the outcomes of a table were measured, by the report beside it; empty without one."""
    try:
        told = json.loads((table.parent / "report.json").read_text())["origin"]
        old = {key: str(text) for key, text in told.items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return {}
    first = {key: text for key, text in old.items() if key.startswith(MEASURED)}
    return first or {MEASURED + key: text for key, text in old.items()}


def _write(
    study: FrozenStudy, args: argparse.Namespace, outcomes: list[Outcome]
) -> tuple[list[dict[str, Any]], list[str]]:
    """Write the report; returns its table and its verdict."""
    rows, pairs = study.summary(outcomes), study.head_to_head(outcomes)
    said = study.verdict(outcomes)
    tables = [("Every way", rows)]
    if pairs:
        tables.append(("Two ways at the same moments", pairs))
    recordings = dict.fromkeys(one.recording for one in outcomes)
    at = {(one.recording, one.step) for one in outcomes}
    made = study_origin(
        n=f"{len(at)} moments of {len(recordings)} runs",
        seeds=in_short([one.seed for one in outcomes]),
        runs=", ".join(recordings),
        **(_measurement(args.table) if args.table else {}),
    )
    write_csv(args.out / "summary.csv", rows)
    write_csv(args.out / "head-to-head.csv", pairs)
    write_outcomes(args.out / "moments.csv", outcomes)
    figures = [(study.caption, save(study.figure(outcomes), args.out, study.name)[0])]
    write_report(Report(study.title, study.claim, said, figures, tables, made), args.out)
    return rows, said


def check_model(name: str) -> None:
    """Raises UserError for a model that is none of MODELS."""
    if name not in MODELS:
        raise unknown("model", name, MODELS)


def chosen_ways(args: argparse.Namespace) -> list[str]:
    """The requested ways of weighing, uniform weights first, the baseline of all.

    Raises UserError for an unknown one.
    """
    for name in args.ways:
        if name not in WAYS:
            raise unknown("way of weighing", name, WAYS)
    return list(dict.fromkeys(("uniform", *args.ways)))


def chosen_runs(args: argparse.Namespace) -> list[RunReader]:
    """The runs with moments, of any task.

    Raises UserError if there are none, or a named run has none or is of a task that is not known.
    """
    if args.moments < 1:
        raise UserError("--moments must be at least 1")
    store, envs = Store(args.store), {task(env).name for env in args.env}
    named = [store.run(name) for name in dict.fromkeys(args.runs)]
    for run in named:
        if _usable(run):
            task(run.env)
        else:
            raise UserError(
                f"run {run.run_id} has no moment: it kept no policy of its fits, or no buffer, or "
                f"it ended less than {NEWEST:,} steps after its exploration"
            )
    runs = named or [run for run in store.runs() if run.env in envs and _usable(run)]
    if not runs:
        raise UserError(
            f"{args.store}/ has no run with a buffer and policies of fits at least {NEWEST:,} "
            "steps after exploration: "
            f"tom record-sac --env {min(envs, key=task_rank)} --steps 20000 makes one"
        )
    return sorted(runs, key=lambda run: (task_rank(run.env), run.run_id))


def _usable(run: RunReader) -> bool:
    has_both = not {"buffer", "policies"} & set(run.left_out)
    return run.is_run and run.env != ROAD and has_both and bool(moments(run, 1))
