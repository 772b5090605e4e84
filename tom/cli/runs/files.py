"""`tom runs verify|repair|export|size|prune`: the files of runs."""

import argparse
import json
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from tom import readable
from tom.cli.tables import name_problems, show
from tom.errors import UserError
from tom.harmless import terminal
from tom.record import RunReader, Store, manage
from tom.record.export import EXPORTERS, export, export_small
from tom.record.layout import WEIGHINGS
from tom.record.thin import OPTIONAL, SERIES

MB = 1e6


def add_verbs(verbs, add_verb) -> None:
    verb = add_verb(
        verbs, "verify", verify_runs, "read every file of runs [all]; 1 if any is damaged"
    )
    verb.add_argument("run_ids", metavar="RUN", nargs="*")
    verb = add_verb(verbs, "repair", repair_runs, "mend damaged runs; nothing is lost")
    verb.add_argument("run_ids", metavar="RUN", nargs="+")
    verb = add_verb(
        verbs, "export", export_runs, "write runs [all finished ones] in another format"
    )
    verb.add_argument("run_ids", metavar="RUN", nargs="*")
    verb.add_argument("--format", choices=tuple(EXPORTERS), help="[csv]")
    verb.add_argument(
        "--small", action="store_true", help="a small copy of the run folder, to show and share"
    )
    verb.add_argument(
        "--keep", nargs="+", choices=tuple(OPTIONAL), default=[], metavar="PART",
        help="what a small copy keeps whatever its size: " + ", ".join(OPTIONAL),
    )  # fmt: skip
    verb.add_argument(
        "--without", nargs="+", choices=(*SERIES, *OPTIONAL), default=[], metavar="PART",
        help=f"what a small copy leaves out: {', '.join(SERIES)}, of which it else has a few, "
        + ", ".join(OPTIONAL),
    )  # fmt: skip
    verb.add_argument("--out", type=Path, default=Path("exports"), help="folder [exports/]")
    text = "write the store's README.md: its small copies, and how each was made"
    add_verb(verbs, "index", write_index, text)
    verb = add_verb(verbs, "size", size, "what runs [all] take on the disk, in MB")
    verb.add_argument("run_ids", metavar="RUN", nargs="*")
    verb = add_verb(verbs, "prune", prune, "delete old checkpoints of runs [all finished ones]")
    verb.add_argument("run_ids", metavar="RUN", nargs="*")
    verb.add_argument("--keep", type=int, default=1, help="checkpoints to keep of each run [1]")
    verb.add_argument("--dry-run", action="store_true", help="say what it would free")


def verify_runs(args: argparse.Namespace) -> int:
    from tom.record.integrity import verify

    store = Store(args.store)
    runs = _chosen(store, args.run_ids)
    problems = {run.run_id: verify(run) for run in runs}
    if args.json:
        print(json.dumps({"runs": problems, "store": store.problems}))
    else:
        for problem in [f"{r}: {text}" for r, texts in problems.items() for text in texts]:
            print(terminal(problem))
        for problem in store.problems:
            print(terminal(problem))
        bad = sum(map(bool, problems.values()))
        print(f"{len(problems)} runs read, {bad} with problems")
    return 1 if any(problems.values()) or store.problems else 0


def repair_runs(args: argparse.Namespace) -> int:
    from tom.record.integrity import repair

    repairs = {run.run_id: repair(run) for run in _chosen(Store(args.store), args.run_ids)}
    if args.json:
        print(json.dumps(repairs))
    else:
        for run_id, done in repairs.items():
            for line in done or ["nothing to mend"]:
                print(terminal(f"{run_id}: {line}"))
    return 0


def export_runs(args: argparse.Namespace) -> int:
    if args.keep and not args.small:
        raise UserError("--keep says what a small copy keeps: add --small")
    if args.format and args.small:
        raise UserError("--small copies run folders as they are: leave out --format")
    if args.without and not args.small:
        raise UserError("--without says what a small copy leaves out: add --small")
    if both := sorted({*args.keep} & {*args.without}):
        raise UserError(f"--keep and --without both name {', '.join(both)}: choose one")
    runs = _finished(Store(args.store), args.run_ids)
    if not runs:
        raise UserError(f"{args.store}/ has no finished runs: name those to export")
    with _all_or_none(args.out) as made:
        for run in runs:
            for path in _exported(run, args):
                made.append(path)
    paths = [str(path) for path in made]
    print(json.dumps(paths) if args.json else "\n".join(map(terminal, paths)))
    return 0


def _exported(run: RunReader, args: argparse.Namespace) -> Iterator[Path]:
    """Export a run; a small copy brings copies of the weighings of its buffer."""
    if args.small:
        from tom.reports.weighing_files import copy_small

        yield export_small(run, args.out, args.keep, args.without)
        yield from copy_small(args.store, run.run_id, args.out)
    else:
        yield export(run, args.format or "csv", args.out)


@contextmanager
def _all_or_none(folder: Path) -> Iterator[list[Path]]:
    """Collect the paths made in `folder`; after an error all of them are removed again."""
    made: list[Path] = []
    new = [place for place in (folder / WEIGHINGS, folder) if not place.exists()]
    try:
        yield made
    except BaseException:
        for path in made:
            shutil.rmtree(path) if path.is_dir() else path.unlink()
        for place in new:
            with suppress(OSError):  # not empty, or never made
                place.rmdir()
        raise


def write_index(args: argparse.Namespace) -> int:
    from tom.reports.index import NAME, index, small_copies, write
    from tom.reports.weighing_files import of_run

    store = Store(args.store)
    runs = small_copies(store)
    name_problems(store)
    if not runs:
        raise UserError(f"{store.path}/ has no small copies: tom runs export --small makes them")
    path = store.path / NAME
    write(path, index(runs, [w for run in runs for w in of_run(store.path, run.run_id)]))
    print(json.dumps(str(path)) if args.json else terminal(path))
    return 0


def size(args: argparse.Namespace) -> int:
    store = Store(args.store)
    bytes_of = {run.run_id: manage.sizes(run) for run in _chosen(store, args.run_ids)}
    name_problems(store)
    if args.json:
        print(json.dumps(bytes_of))
        return 0
    largest = sorted(bytes_of.items(), key=lambda item: -sum(item[1].values()))
    rows = [(name, *_megabytes([*parts.values(), sum(parts.values())])) for name, parts in largest]
    total = sum(sum(parts.values()) for parts in bytes_of.values())
    show(f"{readable.size(total)} in {len(rows)} runs", ("run", *manage.PARTS, "all"), rows)
    return 0


def prune(args: argparse.Namespace) -> int:
    if args.keep < 0:
        raise UserError(f"--keep {args.keep}: must be 0 or more")
    runs = _finished(Store(args.store), args.run_ids)
    by_run = {run.run_id: manage.prune(run, args.keep, dry_run=args.dry_run) for run in runs}
    freed = {name: count for name, count in by_run.items() if count}
    if args.json:
        print(json.dumps(freed))
        return 0
    would = "would free" if args.dry_run else "freed"
    for name, count in freed.items():
        print(f"{name}: {would} {readable.size(count)}")
    print(f"{would} {readable.size(sum(freed.values()))} in all")
    return 0


def _chosen(store: Store, run_ids: Sequence[str]) -> list[RunReader]:
    """The named runs, each once, or all.

    Raises UserError for an unknown name, before anything is done.
    """
    store.ensure_there()
    named = dict.fromkeys(run_ids)
    return [store.run(run_id) for run_id in named] if named else store.runs()


def _finished(store: Store, run_ids: Sequence[str]) -> list[RunReader]:
    """The named runs, or all finished runs."""
    runs = _chosen(store, run_ids)
    name_problems(store)
    return runs if run_ids else [run for run in runs if run.status.state == "finished"]


def _megabytes(counts: Sequence[int]) -> list[str]:
    return [readable.number(count / MB) for count in counts]
