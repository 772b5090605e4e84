"""`tom runs rename|tag|note|trash|restore`: labels of runs, and the trash."""

import argparse
import json
from dataclasses import asdict

from tom.harmless import terminal, terminal_lines
from tom.record import Store, manage
from tom.record.labels import Labels


def add_verbs(verbs, add_verb) -> None:
    verb = add_verb(verbs, "rename", rename, 'give a run a display name ("" takes it away)')
    verb.add_argument("run_id", metavar="RUN")
    verb.add_argument("name", metavar="NAME")
    verb = add_verb(verbs, "tag", tag, "add tags to a run, or remove some")
    verb.add_argument("run_id", metavar="RUN")
    verb.add_argument("tags", metavar="TAG", nargs="*")
    verb.add_argument("--remove", metavar="TAG", nargs="+", default=[], help="take these away")
    verb = add_verb(verbs, "note", note, 'give a run a note ("" takes it away)')
    verb.add_argument("run_id", metavar="RUN")
    verb.add_argument("text", metavar="TEXT")
    verb = add_verb(
        verbs, "trash", trash, "move runs into the store's .trash/, or list what is there"
    )
    verb.add_argument("run_ids", metavar="RUN", nargs="*")
    verb = add_verb(verbs, "restore", restore, "move runs back out of the trash")
    verb.add_argument("run_ids", metavar="RUN", nargs="+")


def rename(args: argparse.Namespace) -> int:
    return _say(args, manage.rename(Store(args.store), args.run_id, args.name))


def tag(args: argparse.Namespace) -> int:
    return _say(args, manage.tag(Store(args.store), args.run_id, args.tags, args.remove))


def note(args: argparse.Namespace) -> int:
    return _say(args, manage.note(Store(args.store), args.run_id, args.text))


def trash(args: argparse.Namespace) -> int:
    store = Store(args.store)
    store.ensure_there()
    if not args.run_ids:
        return _list(args, manage.trashed(store))
    run_ids = list(dict.fromkeys(args.run_ids))
    for run_id in run_ids:  # what is refused is refused before any run is moved
        with manage.unwritten(store.run(run_id)):
            pass
    return _list(args, [str(manage.trash(store, run_id)) for run_id in run_ids])


def restore(args: argparse.Namespace) -> int:
    store = Store(args.store)
    run_ids = list(dict.fromkeys(args.run_ids))
    for run_id in run_ids:
        manage.check_restorable(store, run_id)
    return _list(args, [str(manage.restore(store, run_id)) for run_id in run_ids])


def _say(args: argparse.Namespace, labels: Labels) -> int:
    if args.json:
        print(json.dumps(asdict(labels)))
    else:
        tags = f" [{', '.join(labels.tags)}]" if labels.tags else ""
        print(terminal(f"{args.run_id}: {labels.name or 'no name'}{tags}"))
        print(terminal_lines(labels.note), end="\n" if labels.note else "")
    return 0


def _list(args: argparse.Namespace, lines: list[str]) -> int:
    if args.json:
        print(json.dumps(lines))
    else:
        print("\n".join(map(terminal, lines)) if lines else "nothing")
    return 0
