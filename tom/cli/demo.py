"""`tom demo`: road-and-rocks with three learners, then a live online run, watched in the studio."""

import argparse
import signal
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from tom import readable
from tom.cli.parser import folder, seed_number
from tom.cli.signals import on_stopping
from tom.cli.tables import show, summary
from tom.envs import ROAD
from tom.machine.processes import Process, start, stop
from tom.record import RunReader, Store
from tom.sweep import train_all

ROAD_LEARNERS = ("mle", "pmac", "tom")
ONLINE_LEARNERS = ("mle", "tom")
ONLINE_ENV = "inverted-pendulum"
ONLINE_STEPS = 2500
STUDIO_GRACE_S = 20.0


def add_parser(subparsers, arguments: list[str]) -> None:
    parser = subparsers.add_parser(
        "demo",
        description="Train road-and-rocks (MLE, PMAC, TOM), then inverted pendulum (MLE, TOM), "
        "while the studio shows them. --headless does the same without servers.",
    )
    parser.add_argument("--store", type=folder, default=Path("runs"), help="run store (runs/)")
    parser.add_argument("--headless", action="store_true", help="no server, no browser")
    parser.add_argument("--seed", type=seed_number, default=0)
    parser.add_argument("--no-browser", action="store_true", help="print the address only")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    store = Store(args.store)
    try:
        with on_stopping(signal.default_int_handler):
            return _demonstrate(store, args)
    except KeyboardInterrupt:
        return 0


def _demonstrate(store: Store, args: argparse.Namespace) -> int:
    if args.headless:
        return _train_all(store, args)
    with _studio(args) as studio:
        code = _train_all(store, args)
        print("Look at Compare (both learners' returns), Weights (where TOM looks) and Road")
        print("and rocks (the heatmap). The studio stays up until Ctrl-C.", flush=True)
        studio.wait()
        return code


def commands(store: Path, seed: int, headless: bool) -> dict[str, tuple[str, ...]]:
    """The arguments of the five trainings of the demo."""
    road = [(ROAD, learner, ()) for learner in ROAD_LEARNERS]
    online = [(ONLINE_ENV, name, ("--steps", str(ONLINE_STEPS))) for name in ONLINE_LEARNERS]
    shared = ("--store", str(store), "--seed", str(seed))
    quiet = ("--no-rerun",) if headless else ()
    return {
        f"{env} {learner}": ("--env", env, "--learner", learner, *extra, *shared, *quiet)
        for env, learner, extra in [*road, *online]
    }


def _train_all(store: Store, args: argparse.Namespace) -> int:
    before = {r.run_id for r in store.runs()}
    codes = train_all(commands(store.path, args.seed, args.headless))
    done = [r for r in store.runs() if r.run_id not in before]
    _print_table(sorted(done, key=lambda r: (r.env, r.learner)))
    failed = [name for name, code in codes.items() if code]
    if failed:
        print(f"tom demo: failed: {', '.join(failed)}", file=sys.stderr)
    return 1 if failed else 0


def _print_table(runs: list[RunReader]) -> None:
    columns = ("environment", "learner", "steps", "last return", "best return", "run")
    rows = [
        (
            row["env"],
            row["learner"],
            str(row["env_step"]),
            readable.score(row["last_return"]),
            readable.score(row["best_return"]),
            row["run_id"],
        )
        for row in map(summary, runs)
    ]
    show("What was trained", columns, rows)


@contextmanager
def _studio(args: argparse.Namespace) -> Iterator[Process]:
    command = [sys.executable, "-m", "app", "--store", str(args.store)]
    # In this terminal's session, so that Ctrl-C reaches the studio too.
    studio = start(command + (["--no-browser"] if args.no_browser else []), None, session=False)
    try:
        yield studio
    finally:
        stop([studio], STUDIO_GRACE_S)
