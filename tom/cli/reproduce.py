"""`tom reproduce`: compute a claim of the paper again and test it against its acceptance.

A study says what is computed and found (tom/studies); here are its progress, its files, its report,
what is printed, and the exit code.
"""

import signal
import time
from argparse import Namespace
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from pathlib import Path
from types import ModuleType

from matplotlib import rc_context

from tom.cli.output import print_result, show_rows
from tom.cli.parser import add_json, folder
from tom.errors import DivergedError
from tom.machine.processes import on_stopping
from tom.readable import whole
from tom.reports.figures import STYLE, save
from tom.reports.report import origin, read_tables, write_csv, write_report
from tom.studies import STUDIES, load
from tom.studies.study import Findings, make_folder, say
from tom.studies.verdicts import verdict_of

LONG = 60
"""maximum lines of a table that is printed"""


def add_parser(subparsers, arguments: list[str]) -> None:
    parser = subparsers.add_parser(
        "reproduce",
        description="Reproduce a claim of the paper: compute it, print its acceptance figures and "
        "write its figure and table. Exit code 0 if all figures are met, else 1.",
    )
    studies = parser.add_subparsers(title="studies", metavar="STUDY", required=True)
    for name in STUDIES:
        study = load(name)
        doc = study.__doc__ or ""
        own = studies.add_parser(name, help=doc.partition("\n")[0], description=doc)
        own.register("type", "folder", folder)
        own.register("type", "seed", whole(0))
        study.add_options(own)
        out = Path("reports") / name
        own.add_argument("--out", type=Path, default=out, help="[%(default)s]")
        add_json(own, "print the result as JSON")
        own.set_defaults(run=partial(run, study))


def run(study: ModuleType, args: Namespace) -> int:
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
    except KeyboardInterrupt:
        say("stopped")
    except BrokenProcessPool:
        say("a process was killed; fewer --jobs need less memory. The same command continues")
    except OSError as error:
        say(f"{error}. The same command continues")
    except DivergedError as error:
        say(f"failed: {error}")
    return 1


def _run(study: ModuleType, args: Namespace) -> int:
    begun = time.monotonic()
    with rc_context(STYLE):
        found: Findings = study.find(args)
    make_folder(args.out)
    files = {name: list(rows) for name, rows in found.files.items()}
    titles = dict(found.titles)
    if found.checks:
        files["checks"], titles = list(found.checks), {"checks": "Acceptance", **titles}
    for name, rows in files.items():
        write_csv(args.out / f"{name}.csv", rows)
    sentences = list(found.sentences)
    if verdict := verdict_of(study, read_tables(args.out / f"{name}.csv" for name in files)):
        question = verdict.question or study.QUESTION
        sentences.append(f"{question} {verdict.word}. {verdict.sentence}")
        if verdict.against:
            sentences.append(f"Against it: {verdict.against}")
    pictures = [
        (caption, save(figure, args.out, name)[0])
        for name, (caption, figure) in found.figures.items()
    ]
    hours = f"{(time.monotonic() - begun) / 3600:.2f} (cases kept from an earlier call not counted)"
    made = origin() | {"hours": hours} | dict(found.origin)
    tables = [(title, files[name]) for name, title in titles.items()]
    write_report(args.out, study.TITLE, study.CLAIM, sentences, pictures, tables, made)

    def shown() -> None:
        for title, rows in tables:
            if 0 < len(rows) <= LONG or title == "Acceptance":
                show_rows(title, rows)
            elif rows:
                print(f"{title}: in the report")
        print("\n".join([*sentences, str(args.out)]))

    content = {name: files[name] for name in titles}
    print_result(args, content | {"verdict": sentences, "out": str(args.out)}, shown)
    return int(any(row["met"] is False for row in found.checks))
