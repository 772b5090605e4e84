"""`tom runs`: list and manage the runs of a store."""

import argparse
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from tom import readable
from tom.cli.output import print_problems, print_result, show, summary
from tom.cli.parser import add_json, add_store, folder
from tom.errors import UserError
from tom.harmless import terminal
from tom.readable import flat, score, short, whole
from tom.record import RunReader, Store, manage
from tom.record.export import EXPORTERS, export, export_small
from tom.record.layout import RUN_ID
from tom.record.thin import OPTIONAL, SERIES

STATES = ("running", "finished", "stopped", "failed", "dead", "unknown")

Verb = Callable[[argparse.Namespace], int]
Argument = tuple[str, dict[str, Any]]
VERBS: dict[str, tuple[Verb, str, tuple[Argument, ...]]] = {}
"""by name: its function, what it does, and its arguments"""


def argument(name: str, **options: Any) -> Argument:
    return name, options


def verb(name: str, text: str, *arguments: Argument) -> Callable[[Verb], Verb]:
    """The function is what `tom runs NAME` does."""

    def add(run: Verb) -> Verb:
        VERBS[name] = run, text, arguments
        return run

    return add


RUN = argument("run_id", metavar="RUN")
ANY = argument("run_ids", metavar="RUN", nargs="*")
SOME = argument("run_ids", metavar="RUN", nargs="+")


def add_parser(subparsers, arguments: list[str]) -> None:
    parser = subparsers.add_parser(
        "runs", description="List the runs of a store, or do something with them."
    )
    add_store(parser)
    add_json(parser)
    parser.set_defaults(run=list_runs, task=None, learner=None, tag=None, state=None)
    verbs = parser.add_subparsers(title="what to do", metavar="VERB")
    for name, (run, text, own) in VERBS.items():
        added = verbs.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
        # Suppressed: the options may also stand before the verb.
        kept: dict[str, Any] = {"default": argparse.SUPPRESS}
        added.add_argument("--store", type=folder, help="run store [runs/]", **kept)
        added.add_argument("--json", action="store_true", help="print JSON", **kept)
        for option, options in own:
            added.add_argument(option, **options)
        added.set_defaults(run=run)


def _chosen(store: Store, run_ids: Sequence[str], *, finished: bool = False) -> list[RunReader]:
    """The named runs, each once, or all, or all that are `finished`; prints what cannot be read.

    Raises UserError for an unknown name, before anything is done.
    """
    store.ensure_there()
    if run_ids:
        return [store.run(run_id) for run_id in dict.fromkeys(run_ids)]
    runs = store.runs()
    print_problems(store)
    return [run for run in runs if run.status.state == "finished"] if finished else runs


# What there is


@verb(
    "list",
    "list the runs, newest first",
    # Named like that, it is not imported: runs are listed without their task's code.
    argument("--env", dest="task", metavar="ENV", help="only this environment"),
    argument("--learner", help="only this learner"),
    argument("--tag", help="only runs with this tag"),
    argument("--state", choices=STATES, help="only runs in this state"),
)
def list_runs(args: argparse.Namespace) -> int:
    shown = [
        run
        for run in _chosen(Store(args.store), ())
        if args.task in (None, run.env)
        and args.learner in (None, run.learner)
        and args.state in (None, run.status.shown)
        and (args.tag is None or args.tag in run.labels.tags)
    ]
    rows = list(map(_row, shown))
    columns = {
        "run": [row["run_id"] for row in rows],
        "name": [row["name"] for row in rows],
        "tags": [", ".join(row["tags"]) for row in rows],
        "state": [run.shown for run in shown],
        "step": [str(row["env_step"]) for row in rows],
        "last return": [score(row["last_return"]) for row in rows],
        "best return": [score(row["best_return"]) for row in rows],
        "problems": ["; ".join(row["problems"]) for row in rows],
    }
    filled = {name: cells for name, cells in columns.items() if any(cells) or name == "run"}
    title, cells = f"{len(rows)} runs in {args.store}", zip(*filled.values(), strict=True)
    return print_result(args, rows, lambda: show(title, list(filled), cells))


def _row(run: RunReader) -> dict[str, Any]:
    return {
        **summary(run),
        "name": run.labels.name,
        "tags": list(run.labels.tags),
        "state": run.status.shown,
        "problems": run.problems,
        "small_copy": run.small_copy,
        "left_out": list(run.left_out),
    }


@verb("show", "everything known about a run", RUN)
def show_run(args: argparse.Namespace) -> int:
    run = Store(args.store).run(args.run_id)
    from tom.data.card import sentence
    from tom.record.task_record import card_of  # tasks take a second to import

    row, card = {**_row(run), "note": run.labels.note}, card_of(run)
    if args.json:
        return print_result(args, {**row, "description": run.config, "card": card}, ())
    row["state"] = run.shown
    del row["small_copy"]  # the state says so
    described = {**row, "reason": run.status.reason, **flat(run.config)}
    texts = [(name, text) for name, value in described.items() if (text := _text(value))]
    show(run.run_id, ("what", "value"), texts)
    last = run.metrics().ffill().tail(1)
    if len(last):
        values = last.iloc[0].to_dict()
        show("last metrics", ("metric", "value"), [(k, short(v, 6)) for k, v in values.items()])
    if card:
        print(sentence(card))
    for notice in run.notices():
        print(terminal(f"step {notice.get('env_step')}: {notice.get('message')}"))
    return 0


@verb(
    "diff",
    "settings, versions and results in which two runs differ",
    argument("first", metavar="RUN"),
    argument("second", metavar="RUN"),
)
def diff(args: argparse.Namespace) -> int:
    both = []
    for run in (Store(args.store).run(run_id) for run_id in (args.first, args.second)):
        if not run.given:
            raise UserError(f"run '{run.run_id}' has no settings to compare")
        own = {name: run.config.get(name) for name in ("config", "machine")}
        own["matmul"] = (run.config.get("matmul") or {}).get("chosen")
        made = [run.config, *run.config.get("resumes", ())]  # a resume may have other versions
        used = [flat({name: one.get(name) for name in ("versions", "git_commit")}) for one in made]
        own |= {n: ", ".join(dict.fromkeys(u[n] for u in used if u.get(n))) for n in used[0]}
        results = ("state", "env_step", "last_return", "best_return")
        both.append(flat(own) | {name: getattr(run.status, name) for name in results})
    first, second = both
    names = [n for n in dict.fromkeys([*first, *second]) if first.get(n) != second.get(n)]
    values = {name: [first.get(name), second.get(name)] for name in names}
    rows = [(name, *map(_text, both)) for name, both in values.items()]
    title, columns = f"{len(rows)} differences", ("what", args.first, args.second)
    return print_result(args, values, lambda: show(title, columns, rows))


def _text(value: Any) -> str:
    if value is None or value == []:
        return ""
    return ", ".join(map(str, value)) if isinstance(value, list) else str(value)


# Labels and the trash


@verb(
    "rename",
    'give a run a display name ("" takes it away)',
    RUN,
    argument("name", metavar="NAME"),
)
@verb(
    "tag",
    "add tags to a run, or remove some",
    RUN,
    argument("add", metavar="TAG", nargs="*"),
    argument("--remove", metavar="TAG", nargs="+", default=[], help="tags to remove"),
)
@verb("note", 'give a run a note ("" takes it away)', RUN, argument("note", metavar="TEXT"))
def label(args: argparse.Namespace) -> int:
    given = {n: getattr(args, n) for n in ("name", "note", "add", "remove") if hasattr(args, n)}
    labels = manage.label(Store(args.store), args.run_id, **given)
    tags = f" [{', '.join(labels.tags)}]" if labels.tags else ""
    first = f"{args.run_id}: {labels.name or 'no name'}{tags}"
    return print_result(args, asdict(labels), [first, *labels.note.splitlines()])


@verb("trash", "move runs into the store's .trash/, or list what is there", ANY)
def trash(args: argparse.Namespace) -> int:
    store = Store(args.store)
    store.ensure_there()
    if not args.run_ids:
        trashed = manage.trashed(store)
        return print_result(args, trashed, trashed or ["nothing"])
    places = [str(place) for place in manage.trash(store, *args.run_ids)]
    return print_result(args, places, places)


@verb("restore", "move runs back out of the trash", SOME)
def restore(args: argparse.Namespace) -> int:
    places = [str(place) for place in manage.restore(Store(args.store), *args.run_ids)]
    return print_result(args, places, places)


# Files


@verb("verify", "read every file of runs [all]; 1 if any is damaged", ANY)
def verify(args: argparse.Namespace) -> int:
    from tom.record import integrity

    store = Store(args.store)
    problems = {run.run_id: integrity.verify(run) for run in _chosen(store, args.run_ids)}
    bad = sum(map(bool, problems.values()))
    lines = [f"{run_id}: {text}" for run_id, texts in problems.items() for text in texts]
    lines.append(f"{len(problems)} runs read, {bad} with problems")
    print_result(args, {"runs": problems, "store": store.problems}, lines)
    return 1 if bad or store.problems else 0


@verb("repair", "mend damaged runs; nothing is lost", SOME)
def repair(args: argparse.Namespace) -> int:
    from tom.record import integrity

    runs = _chosen(Store(args.store), args.run_ids)
    repairs = {run.run_id: integrity.repair(run) for run in runs}
    lines = [
        f"{name}: {line}" for name, done in repairs.items() for line in done or ["nothing to mend"]
    ]
    return print_result(args, repairs, lines)


@verb(
    "export",
    "write runs [all finished ones] in another format",
    ANY,
    argument("--format", choices=tuple(EXPORTERS), help="[csv]"),
    argument("--small", action="store_true", help="write small copies, to show and share"),
    argument(
        "--keep", nargs="+", choices=tuple(OPTIONAL), default=[], metavar="PART",
        help="parts that a small copy keeps at any size: " + ", ".join(OPTIONAL),
    ),
    argument(
        "--without", nargs="+", choices=(*SERIES, *OPTIONAL), default=[], metavar="PART",
        help=f"parts that a small copy leaves out: {', '.join(SERIES)} (else it has a few), "
        + ", ".join(OPTIONAL),
    ),
    argument(
        "--rows", type=whole(0), nargs="?", const=True, metavar="STEP",
        help="the buffer's rows of the fit at STEP [the last kept]; a RUN may also be a weighing",
    ),
    argument("--out", type=Path, default=Path("exports"), help="folder [exports/]"),
)  # fmt: skip
def export_runs(args: argparse.Namespace) -> int:
    if (args.keep or args.without) and not args.small:
        raise UserError("--keep and --without apply to a small copy: add --small")
    asked = {"--format": args.format, "--small": args.small or None, "--rows": args.rows}
    chosen = [name for name, value in asked.items() if value is not None]
    if len(chosen) > 1:
        raise UserError(f"{' and '.join(chosen)} are different exports: choose one")
    if both := sorted({*args.keep} & {*args.without}):
        raise UserError(f"--keep and --without both name {', '.join(both)}: choose one")
    of_rows = args.rows is not None and args.run_ids  # which may name weighings as well
    runs = [] if of_rows else _chosen(Store(args.store), args.run_ids, finished=True)
    if not (runs or of_rows):
        raise UserError(f"{args.store}/ has no finished runs: name those to export")
    names = dict.fromkeys(args.run_ids or (run.run_id for run in runs))
    if args.rows is not None:
        from tom.frames import export_rows

        step = None if args.rows is True else args.rows  # the last kept
        made = [export_rows(name, args.store, step, args.out) for name in names]
    elif args.small:  # with the weighings of its buffer
        from tom.reports.weighing_files import copy_small

        made = [export_small(run, args.out, args.keep, args.without) for run in runs]
        made += [copy for name in names for copy in copy_small(args.store, name, args.out)]
    else:
        made = [export(run, args.format or "csv", args.out) for run in runs]
    paths = list(map(str, made))
    return print_result(args, paths, paths)


@verb("index", "write the store's README.md: its small copies, and how each was made")
def index(args: argparse.Namespace) -> int:
    from tom.reports import index as page

    store = Store(args.store)
    path = str(page.write(store))
    print_problems(store)
    return print_result(args, path, [path])


@verb(
    "prune",
    "delete old checkpoints of runs [all finished ones]",
    ANY,
    argument("--keep", type=whole(0), default=1, help="checkpoints to keep of each run [1]"),
    argument("--dry-run", action="store_true", help="only say what it would free"),
)
def prune(args: argparse.Namespace) -> int:
    runs = _chosen(Store(args.store), args.run_ids, finished=True)
    counts = {run.run_id: manage.prune(run, args.keep, dry_run=args.dry_run) for run in runs}
    freed = {name: count for name, count in counts.items() if count}
    would = "would free" if args.dry_run else "freed"
    lines = [f"{name}: {would} {readable.size(count)}" for name, count in freed.items()]
    return print_result(
        args, freed, [*lines, f"{would} {readable.size(sum(freed.values()))} in all"]
    )


@verb(
    "import",
    "turn what another tracker recorded into runs, for Curves",
    argument(
        "path", metavar="PATH", help="TensorBoard's event file or folder, or W&B's exported CSV"
    ),
    argument("--env", required=True, help="the task, such as Hopper-v5"),
    argument("--name", default="", help="name of the run [the file's]"),
    argument(
        "--return", dest="returned", default="", metavar="METRIC",
        help="the metric to take as the return [eval/mean_reward or similar]",
    ),
)  # fmt: skip
def import_runs(args: argparse.Namespace) -> int:
    from tom.own_loop.imported import import_metrics  # tasks take a second to import

    made = import_metrics(args.path, args.env, args.store, args.name, args.returned)
    return print_result(args, made, made)


@verb(
    "fetch",
    "copy runs [all] from an object store into the store",
    argument("url", metavar="s3://BUCKET/PREFIX", help="the --store of `tom sweep`"),
    ANY,
)
def fetch(args: argparse.Namespace) -> int:
    from tom.record.bucket import Bucket, fetch_run, newest

    bucket, store = Bucket.open(args.url), Store(args.store)
    done: dict[str, str] = {}
    try:
        wanted = args.run_ids or [
            name
            for name in bucket.folders()
            if RUN_ID.fullmatch(name) and newest(bucket.names(name))  # else it has only begun
        ]
        if not wanted:
            raise UserError(f"no runs in {args.url}: is it the --store of a sweep?")
        for run_id in wanted:
            done[run_id] = fetch_run(bucket, run_id, store)
            if not args.json:
                print(terminal(f"{run_id} {done[run_id]}"), flush=True)
    except OSError as error:
        raise UserError(f"{args.url}: {error}") from error
    return print_result(args, done, ())
