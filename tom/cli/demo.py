"""`tom demo`: road-and-rocks with three learners, then a live online run, watched in the studio."""

import argparse
import signal
import sys

from tom import readable
from tom.cli.output import show
from tom.cli.parser import add_store
from tom.envs import ROAD
from tom.machine.processes import on_stopping, start, stop
from tom.readable import whole
from tom.record import Store
from tom.sweep.engine import train_all

ONLINE = ("--env", "inverted-pendulum", "--steps", "2500")
TRAININGS = {
    **{f"{ROAD} {name}": ("--env", ROAD, "--learner", name) for name in ("mle", "pmac", "tom")},
    **{f"inverted-pendulum {name}": (*ONLINE, "--learner", name) for name in ("mle", "tom")},
}
STUDIO_GRACE_S = 20.0


def add_parser(subparsers, arguments: list[str]) -> None:
    parser = subparsers.add_parser(
        "demo",
        description="Train road-and-rocks (MLE, PMAC, TOM), then inverted pendulum (MLE, TOM), "
        "while the studio shows them. --headless does the same without servers.",
    )
    add_store(parser)
    parser.add_argument("--headless", action="store_true", help="no server, no browser")
    parser.add_argument("--seed", type=whole(0), default=0)
    parser.add_argument("--no-browser", action="store_true", help="print the address only")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    studios = []
    try:
        with on_stopping(signal.default_int_handler):
            if not args.headless:
                command = [sys.executable, "-m", "app", "--store", str(args.store)]
                command += ["--no-browser"] * args.no_browser
                # In this terminal's session, so that Ctrl-C also reaches the studio.
                studios.append(start(command, None, session=False))
            code = _train(args)
            for studio in studios:
                print("The first page, Answer, says where TOM looks and whether that helps;")
                print("Attention shows it. The studio stays up until Ctrl-C.", flush=True)
                studio.wait()
            return code
    except KeyboardInterrupt:
        return 0
    finally:
        stop(studios, STUDIO_GRACE_S)


def _train(args: argparse.Namespace) -> int:
    store = Store(args.store)
    before = {run.run_id for run in store.runs()}
    shared = ("--store", str(store.path), "--seed", str(args.seed))
    quiet = ("--no-rerun",) if args.headless else ()
    codes = train_all({name: (*own, *shared, *quiet) for name, own in TRAININGS.items()})
    made = [run for run in store.runs() if run.run_id not in before]
    columns = ("environment", "learner", "steps", "last return", "best return", "run")
    rows, seen = [], dict[str, list[str]]()
    for run in sorted(made, key=lambda run: (run.env, run.learner)):
        status = run.status
        last, best = readable.score(status.last_return), readable.score(status.best_return)
        rows.append((run.env, run.learner, str(status.env_step), last, best, run.run_id))
        seen.setdefault(run.env, []).append(f"{run.learner} {last}")
    show("What was trained", columns, rows)
    returns = "; ".join(f"{', '.join(of)} on {env}" for env, of in seen.items())
    print(f"At the end a policy returned {returns}. One run of each tells no learner from another.")
    failed = [name for name, code in codes.items() if code]
    if failed:
        print(f"tom demo: failed: {', '.join(failed)}", file=sys.stderr)
    return 1 if failed else 0
