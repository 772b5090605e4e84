"""What the studies of frozen buffers share: the choice of moments, and the table of outcomes."""

import csv
import json
from argparse import ArgumentParser, Namespace
from collections.abc import Mapping, Sequence
from pathlib import Path

from tom.envs import ENVS, ROAD, task, task_rank
from tom.errors import UserError
from tom.record import RunReader, Store
from tom.reports.html import WORDS
from tom.reports.origin import seeds as in_short
from tom.studies.frozen import ERROR, NEWEST, UNIFORM, WAYS, cases, examined, moments
from tom.studies.study import Lab, Row, add_env, add_jobs, add_store, check_known, tasks, whole

OF_MEASURING = ("env", "moments", "seeds", "ways", "store", "jobs", "rows", "models")
"""the options that say what is measured and how"""
KINDS = {"recording": str, "env": str, "step": int, "way": str, "seed": int}
MEASURES = ("ess", "ends", "ends_policy", "footprint", "footprint_uniform", "footprint_noise")
"""the columns of an outcome: the types of those that are no measures, and the measures"""
MEASURED = "measured: "
"""begins what a report that was made anew says of the origin of its outcomes"""


def add_moments(parser: ArgumentParser, ways: Sequence[str]) -> None:
    """Add the options that choose runs, their moments, and ways of weighing."""
    parser.add_argument("runs", nargs="*", metavar="RUN", help="[all of the store that can]")
    add_env(parser, list(ENVS), "[all of ours]")
    parser.add_argument("--moments", type=whole(1), default=8, help="of each run at most [8]")
    parser.add_argument("--seeds", nargs="+", type="seed", default=[0], help="[0]")
    known = ", ".join(WAYS)
    parser.add_argument("--ways", nargs="+", default=list(ways), metavar="WAY", help=known)
    add_store(parser)
    add_jobs(parser)


def chosen_ways(args: Namespace) -> list[str]:
    """The ways of weighing, uniform weights first. Raises UserError for an unknown one."""
    check_known("way of weighing", args.ways, WAYS)
    return list(dict.fromkeys((UNIFORM, *args.ways)))


def chosen_runs(args: Namespace) -> list[RunReader]:
    """The runs with moments, of any task.

    Raises UserError if there are none, or a named run has none or is of a task that is not known.
    """
    store, envs = Store(args.store), tasks(args.env)
    named = [store.run(name) for name in args.runs]
    for run in named:
        if not _usable(run):
            raise UserError(
                f"run {run.run_id} has no moment: it kept no policy of its fits, or no buffer, or "
                f"it ended less than {NEWEST:,} steps after its exploration"
            )
        task(run.env)
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


def add_measuring(parser: ArgumentParser, ways: Sequence[str], models: Sequence[str] = ()) -> None:
    """Add the options of a study that weighs moments, or reads the table of one that did."""
    add_moments(parser, ways)
    parser.add_argument("--rows", type=whole(100), default=6000, help="new transitions [6000]")
    if models:
        known = ", ".join(f"'{name}'" for name in models)
        parser.add_argument("--models", nargs="+", default=list(models), help=f"[{known}]")
    parser.set_defaults(usual={name: parser.get_default(name) for name in OF_MEASURING})
    parser.add_argument(
        "--from", dest="table", type=Path, metavar="FILE",
        help="moments.csv of an earlier report: only its tables and figures are made anew",
    )  # fmt: skip


def measured(args: Namespace, lab: Lab, models: Sequence[str] = ()) -> list[Row]:
    """The outcome of every case, or those of an earlier report.

    Raises UserError for options that have no meaning if nothing is measured.
    """
    if not args.table:
        asked = cases(
            chosen_runs(args), chosen_ways(args), args.seeds, args.moments, models, args.rows
        )
        return lab.compute(
            examined, asked, lambda one: f"{one['recording']} at {one['step']}: {one['way']}"
        )
    given = [name for name, usual in args.usual.items() if getattr(args, name, None) != usual]
    if too_many := [*(f"--{option}" for option in given), *args.runs]:
        raise UserError(
            "--from takes all that its file holds, as it was measured: leave out "
            f"{' '.join(too_many)}"
        )
    return read_outcomes(args.table, bool(models))


def read_outcomes(path: Path, models: bool) -> list[Row]:
    """The outcomes of `moments.csv` beside a report, to the bit.

    Raises UserError if `path` cannot be read, is no such table, or lacks the errors of `models`.
    """
    try:
        with path.open(newline="") as file:
            outcomes = [_outcome(line) for line in csv.DictReader(file)]
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(f"cannot read {path}: {error}") from error
    except (TypeError, ValueError, csv.Error) as error:
        raise UserError(f"{path} is no moments.csv of this study ({error})") from error
    if not outcomes or (models and not models_of(outcomes)):
        raise UserError(f"{path} has no outcome of this study: name the moments.csv of its report")
    return outcomes


def _outcome(line: Mapping[str, str]) -> Row:
    if lacking := [name for name in (*KINDS, *MEASURES) if name not in line]:
        raise ValueError(f"no column {lacking[0]}")
    return {name: KINDS.get(name, float)(text) for name, text in line.items()}


def models_of(outcomes: Sequence[Row]) -> list[str]:
    """The models whose errors the outcomes have."""
    columns = dict.fromkeys(name for one in outcomes for name in one if name.startswith(ERROR))
    return [name.removeprefix(ERROR) for name in columns]


def origin_of_moments(outcomes: Sequence[Row], table: Path | None = None) -> dict[str, str]:
    """The number of moments, the seeds and runs, and how a table was measured that was read."""
    recordings = dict.fromkeys(one["recording"] for one in outcomes)
    at = {(one["recording"], one["step"]) for one in outcomes}
    told = {
        "n": f"{len(at)} moments of {len(recordings)} runs",
        "seeds": in_short([one["seed"] for one in outcomes]),
        "runs": ", ".join(recordings),
    }
    return told | (_measurement(table) if table else {})


def _measurement(table: Path) -> dict[str, str]:
    """How the outcomes of a table were measured, by the report beside it; empty without one."""
    try:
        told = json.loads((table.parent / WORDS).read_text())["origin"]
        old = {key: str(text) for key, text in told.items()}
    except (OSError, ValueError, KeyError, TypeError, AttributeError):
        return {}
    first = {key: text for key, text in old.items() if key.startswith(MEASURED)}
    return first or {MEASURED + key: text for key, text in old.items()}
