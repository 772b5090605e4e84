"""`tom runs`: list and manage the runs of a store."""

import argparse
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tom.cli.parser import folder
from tom.cli.runs import fetch, files
from tom.cli.runs import labels as runs_labels
from tom.cli.tables import name_problems, show, summary
from tom.config import flat
from tom.errors import UserError, unknown
from tom.harmless import terminal
from tom.readable import score, short
from tom.record import RunReader, Status, Store, small_copy

STATES = ("running", "finished", "stopped", "failed", "dead", "unknown")


def add_parser(subparsers, arguments: list[str]) -> None:
    parser = subparsers.add_parser(
        "runs",
        description="List the runs of a store, or do something with them.",
    )
    parser.add_argument("--store", type=folder, default=Path("runs"), help="run store (runs/)")
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.set_defaults(run=list_runs, env=None, learner=None, tag=None, state=None)
    verbs = parser.add_subparsers(title="what to do", metavar="VERB")
    _add_list(verbs)
    one = add_verb(verbs, "show", show_run, "everything known about a run")
    one.add_argument("run_id", metavar="RUN")
    two = add_verb(verbs, "diff", diff, "settings, versions and results in which two runs differ")
    two.add_argument("first", metavar="RUN")
    two.add_argument("second", metavar="RUN")
    runs_labels.add_verbs(verbs, add_verb)
    files.add_verbs(verbs, add_verb)
    fetch.add_verbs(verbs, add_verb)


def add_verb(verbs, name: str, run, text: str) -> argparse.ArgumentParser:
    """Add a verb of `tom runs` with the options that all verbs share."""
    verb = verbs.add_parser(name, help=text, description=text[0].upper() + text[1:] + ".")
    # Suppressed: the options may also stand before the verb.
    kept: dict[str, Any] = {"default": argparse.SUPPRESS}
    verb.add_argument("--store", type=folder, help="run store (runs/)", **kept)
    verb.add_argument("--json", action="store_true", help="print JSON", **kept)
    verb.set_defaults(run=run)
    return verb


def _add_list(verbs) -> None:
    verb = add_verb(verbs, "list", list_runs, "list the runs, newest first")
    verb.add_argument("--env", help="only this environment")
    verb.add_argument("--learner", help="only this learner")
    verb.add_argument("--tag", help="only runs with this tag")
    verb.add_argument("--state", choices=STATES, help="only runs in this state")


def list_runs(args: argparse.Namespace) -> int:
    store = Store(args.store)
    store.ensure_there()
    held = store.runs()
    name_problems(store)
    _check_filters(args, held)
    both = [(run, run.status) for run in held]  # each status is read once: there may be a thousand
    both = [(run, status) for run, status in both if _wanted(run, status, args)]
    rows = [_row(run, status) for run, status in both]
    if args.json:
        print(json.dumps(rows))
        return 0
    cells = {
        "run": [row["run_id"] for row in rows],
        "name": [row["name"] for row in rows],
        "tags": [", ".join(row["tags"]) for row in rows],
        "state": [small_copy.shown(status, run.small_copy) for run, status in both],
        "step": [str(row["env_step"]) for row in rows],
        "last return": [score(row["last_return"]) for row in rows],
        "best return": [score(row["best_return"]) for row in rows],
        "problems": ["; ".join(row["problems"]) for row in rows],
    }
    said = {name: column for name, column in cells.items() if any(column) or name == "run"}
    show(f"{len(rows)} runs in {args.store}", list(said), zip(*said.values(), strict=True))
    return 0


def show_run(args: argparse.Namespace) -> int:
    run = Store(args.store).run(args.run_id)
    if args.json:
        print(
            json.dumps(
                {**_row(run, run.status), "note": run.labels.note, "description": run.config}
            )
        )
        return 0
    row = _row(run, run.status) | {"state": run.shown}
    del row["small_copy"]  # the state says so
    described = {
        **{name: _text(value) for name, value in row.items()},
        "note": run.labels.note,
        "reason": run.status.reason,
        **{name: _text(value) for name, value in flat(run.config).items()},
    }
    described = {name: text for name, text in described.items() if text}
    show(run.run_id, ("what", "value"), list(described.items()))
    last = run.metrics().ffill().tail(1)
    if len(last):
        values = last.iloc[0].to_dict()
        show(
            "last metrics",
            ("metric", "value"),
            [(k, short(v, 6)) for k, v in values.items()],
        )
    for notice in run.notices():
        print(terminal(f"step {notice.get('env_step')}: {notice.get('message')}"))
    return 0


def diff(args: argparse.Namespace) -> int:
    store = Store(args.store)
    pair = [_comparable(store.run(run_id)) for run_id in (args.first, args.second)]
    names = [n for n in dict.fromkeys([*pair[0], *pair[1]]) if pair[0].get(n) != pair[1].get(n)]
    rows = [(name, _text(pair[0].get(name)), _text(pair[1].get(name))) for name in names]
    if args.json:
        print(json.dumps({name: [pair[0].get(name), pair[1].get(name)] for name in names}))
    else:
        show(f"{len(rows)} differences", ("what", args.first, args.second), rows)
    return 0


def _comparable(run: RunReader) -> dict[str, Any]:
    """What two runs may differ in, by dotted name, without what is unique to every run."""
    if not run.config.get("config"):
        raise UserError(f"run '{run.run_id}' has no settings to compare")
    own = {name: run.config.get(name) for name in ("config", "versions", "git_commit", "machine")}
    status = run.status
    results = {name: getattr(status, name) for name in ("state", "env_step", "last_return")}
    return flat(own) | results | {"best_return": status.best_return}


def _check_filters(args: argparse.Namespace, runs: Sequence[RunReader]) -> None:
    """Raises UserError for an environment or learner that is unknown and that no run has."""
    asked = {"env": args.env, "learner": args.learner}
    missing = {
        kind: name
        for kind, name in asked.items()
        if name is not None and name not in {getattr(run, kind) for run in runs}
    }
    if not missing:
        return
    from tom.envs import ENV_NAMES  # they take seconds to import
    from tom.learners import LEARNERS

    for kind, name in missing.items():
        ours = ENV_NAMES if kind == "env" else tuple(LEARNERS)
        if name not in ours:
            raise unknown(kind, name, dict.fromkeys([*ours, *(getattr(r, kind) for r in runs)]))


def _wanted(run: RunReader, status: Status, args: argparse.Namespace) -> bool:
    asked = {"env": run.env, "learner": run.learner, "state": status.shown}
    same = all(getattr(args, name) in (None, value) for name, value in asked.items())
    return same and (args.tag is None or args.tag in run.labels.tags)


def _row(run: RunReader, status: Status) -> dict[str, Any]:
    labels = run.labels
    row = {**summary(run, status), "name": labels.name, "tags": list(labels.tags)}
    row |= {"state": status.shown, "problems": run.problems}
    return {**row, "small_copy": run.small_copy, "left_out": list(run.left_out)}


def _text(value: Any) -> str:
    if value is None or value == []:
        return ""
    return ", ".join(map(str, value)) if isinstance(value, list) else str(value)
