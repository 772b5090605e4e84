"""`tom runs`: what the store holds."""

import argparse
import json
from pathlib import Path

from tom.cli.tables import show
from tom.cli.train import number, summary
from tom.record import Store


def add_parser(subparsers, arguments: list[str]) -> None:
    parser = subparsers.add_parser(
        "runs", help="list the runs of a store", description="List the runs of a store."
    )
    parser.add_argument("--store", type=Path, default=Path("runs"), help="run store (runs/)")
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    runs = Store(args.store).runs()
    rows = [{**summary(r), "problems": r.problems} for r in runs]
    if args.json:
        print(json.dumps(rows))
        return 0
    columns = ("run", "state", "step", "last return", "best return", "problems")
    cells = [
        (
            row["run_id"],
            row["state"],
            str(row["env_step"]),
            number(row["last_return"]),
            number(row["best_return"]),
            "; ".join(row["problems"]),
        )
        for row in rows
    ]
    show(f"{len(rows)} runs in {args.store}", columns, cells)
    return 0
