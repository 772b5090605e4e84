"""`tom doctor`: check whether this machine is ready, and how to fix what is not."""

import argparse
import json
from dataclasses import asdict
from pathlib import Path

from tom.cli.parser import folder
from tom.cli.tables import show


def add_parser(subparsers, arguments: list[str]) -> None:
    parser = subparsers.add_parser(
        "doctor",
        description="Check versions, memory, GPU, matrix products, scenes without a display, "
        "ports, disk, browser and store, with the fix beside each finding. Exit code 1 where "
        "something is bad.",
    )
    parser.add_argument("--store", type=folder, default=Path("runs"), help="run store (runs/)")
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    # Imported here because it imports Rerun and every task.
    from tom.cli.doctor.checks import examine

    findings = examine(args.store)
    if args.json:
        print(json.dumps([asdict(result) for result in findings]))
    else:
        rows = [(result.check, result.state, result.text, result.fix) for result in findings]
        bad = sum(result.state == "bad" for result in findings)
        show(f"{bad} things to mend" if bad else "ready", ("check", "is", "found", "fix"), rows)
    return 1 if any(result.state == "bad" for result in findings) else 0
