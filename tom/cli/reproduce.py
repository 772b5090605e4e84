"""`tom reproduce`: compute a claim of the paper again and test it against its acceptance.

A study says what is computed and found (tom/studies); here are its progress, its files, its report,
what is printed, and the exit code.
"""

import json
import shlex
import signal
import sys
import time
from argparse import Namespace
from collections.abc import Mapping, Sequence
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from pathlib import Path
from typing import Any

from matplotlib import rc_context
from pydantic import ValidationError

from tom.cli.parser import folder, one_line, seed_number
from tom.cli.progress import ProgressReport
from tom.cli.signals import on_stopping
from tom.cli.tables import show
from tom.config import SacRecordingConfig
from tom.errors import DivergedError
from tom.readable import cell
from tom.record import RunReader, Store
from tom.record.files import plain
from tom.reports.figures import STYLE, save
from tom.reports.report import Report, origin, write_csv, write_report
from tom.studies import (
    capacity,
    focus,
    footprint,
    improvement,
    online,
    progression,
    returns,
    road,
    tabular,
)
from tom.studies.study import Lab, Study, Table, make_folder, say
from tom.training.resume import resume, unfinished
from tom.training.run import Stop, train

_BEGUN = time.monotonic()  # a study is a separate process


STUDIES = (road, progression, focus, footprint, capacity, improvement, online, returns, tabular)


def add_parser(subparsers, arguments: list[str]) -> None:
    parser = subparsers.add_parser(
        "reproduce",
        description="Reproduce a claim of the paper: compute it, print its acceptance figures and "
        "write its figure and table. Exit code 0 where all figures are met, 1 otherwise.",
    )
    studies = parser.add_subparsers(title="studies", metavar="STUDY", required=True)
    for study in (module.STUDY for module in STUDIES):
        question = (study.doc or "").partition("\n")[0]
        own = studies.add_parser(study.name, help=question, description=study.doc)
        own.register("type", "folder", folder)
        own.register("type", "seed", seed_number)
        study.options(own)
        out = Path("reports") / study.name
        own.add_argument("--out", type=Path, default=out, help="[%(default)s]")
        own.add_argument("--json", action="store_true", help="print the result as JSON")
        own.set_defaults(run=partial(run, study))


def run(study: Study, args: Namespace) -> int:
    """Run a study. Returns 0 where its acceptance is met, 1 where it is not or cannot be told.

    It cannot on Ctrl-C or SIGTERM, or if a case cannot be finished: a process was killed, the disk
    is full, a loss is not finite.
    """
    for name, value in vars(args).items():
        if isinstance(value, list):  # what is named twice counts once
            setattr(args, name, list(dict.fromkeys(value)))
    try:
        with on_stopping(signal.default_int_handler, [signal.SIGTERM]):
            return _run(study, args)
    except ValidationError as error:
        raise one_line(error) from None
    except KeyboardInterrupt:
        say("stopped")
    except BrokenProcessPool:
        say("a process was killed; fewer --jobs need less memory. The same command goes on")
    except OSError as error:
        say(f"{error}. The same command goes on")
    except DivergedError as error:
        say(f"failed: {error}")
    return 1


def _run(study: Study, args: Namespace) -> int:
    lab = Lab(args.out, getattr(args, "jobs", 1), partial(record, args))
    found = study.find(args, lab)
    make_folder(args.out)
    failed = [str(row["name"]) for row in found.checks if row["met"] is False]
    said = [*found.said, *_judgement(found.checks, failed)]
    tables = [
        *([Table("Acceptance", _judged(found.checks))] if found.checks else []),
        *found.tables,
    ]
    for name, rows in found.files.items():
        write_csv(args.out / f"{name}.csv", rows)
    pictures = []
    for name, (caption, draw) in found.figures.items():
        with rc_context(STYLE):
            pictures.append((caption, save(draw(), args.out, name)[0]))
    hours = (
        f"{(time.monotonic() - _BEGUN) / 3600:.2f} (cases kept from an earlier call not counted)"
    )
    made = origin() | {"hours": hours} | dict(found.origin)
    rows = [(table.title, table.rows) for table in tables]
    write_report(Report(study.title, study.claim, said, pictures, rows, made), args.out)
    if args.json:
        content = {"checks": found.checks} if found.checks else {}
        content |= {**found.json, "verdict": said, "out": str(args.out)}
        print(json.dumps(plain(content), allow_nan=False))
    else:
        _print(tables, [*said, str(args.out)])
    return 1 if failed else 0


def _judgement(checks: Sequence[Mapping[str, Any]], failed: Sequence[str]) -> list[str]:
    """How much of the acceptance is met, in sentences."""
    judged = [row for row in checks if row["met"] is not None]
    if not judged:
        return []
    said = [f"{len(judged) - len(failed)} of {len(judged)} figures of our acceptance are met."]
    return said + ([f"Not met: {'; '.join(failed)}."] if failed else [])


def _judged(checks: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    return [{**row, "met": {True: "yes", False: "NO", None: ""}[row["met"]]} for row in checks]


def _print(tables: Sequence[Table], said: Sequence[str]) -> None:
    for table in tables:
        rows = table.rows if table.brief is None else table.brief
        if rows:
            show(
                table.title,
                tuple(rows[0]),
                [tuple(map(cell, row.values())) for row in rows],
            )
        elif table.rows:
            print(f"{table.title}: in the report")
    print("\n".join(said))


def record(args: Namespace, store: Store, config: SacRecordingConfig) -> RunReader:
    """Make a recording, or go on with one that was stopped; a signal stops it with a checkpoint."""
    make_folder(args.out)
    stop, begun = Stop(), unfinished(store, config)
    work = partial(resume, store, begun) if begun else partial(train, config, store)
    label = f"{config.env} sac seed {config.seed}"
    with on_stopping(stop), ProgressReport(label, config.total_steps, sys.stderr) as progress:
        command = shlex.join(["tom", *sys.argv[1:]])
        made = work(watchers=(progress.consume,), rerun=False, command=command, stop=stop)
    if stop.asked:
        raise KeyboardInterrupt
    return made
