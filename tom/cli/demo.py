"""`tom demo`: road-and-rocks with three learners, then a live online run, watched in the studio."""

import argparse
import signal
import sys
from collections.abc import Sequence

from tom import readable
from tom.cli.parser import add_store, whole
from tom.cli.tables import show
from tom.envs import ROAD
from tom.machine.processes import on_stopping, start, stop
from tom.record import RunReader, Store
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
    try:
        with on_stopping(signal.default_int_handler):
            return _train(args) if args.headless else _show(args)
    except KeyboardInterrupt:
        return 0


def _show(args: argparse.Namespace) -> int:
    """Train while the studio shows it, until Ctrl-C."""
    command = [sys.executable, "-m", "app", "--store", str(args.store)]
    # In this terminal's session, so that Ctrl-C also reaches the studio.
    studio = start(command + ["--no-browser"] * args.no_browser, None, session=False)
    try:
        code = _train(args)
        print("The studio's first page, Answer, says where TOM looks and whether it helps;")
        print("Attention shows it. The studio stays up until Ctrl-C.", flush=True)
        studio.wait()
        return code
    finally:
        stop([studio], STUDIO_GRACE_S)


def _train(args: argparse.Namespace) -> int:
    store = Store(args.store)
    before = {run.run_id for run in store.runs()}
    shared = ("--store", str(store.path), "--seed", str(args.seed))
    quiet = ("--no-rerun",) if args.headless else ()
    codes = train_all({name: (*own, *shared, *quiet) for name, own in TRAININGS.items()})
    made = [run for run in store.runs() if run.run_id not in before]
    columns = ("environment", "learner", "steps", "last return", "best return", "run")
    rows = []
    for run in sorted(made, key=lambda run: (run.env, run.learner)):
        status = run.status
        returns = readable.score(status.last_return), readable.score(status.best_return)
        rows.append((run.env, run.learner, str(status.env_step), *returns, run.run_id))
    show("What was trained", columns, rows)
    print(seen(made))
    failed = [name for name, code in codes.items() if code]
    if failed:
        print(f"tom demo: failed: {', '.join(failed)}", file=sys.stderr)
    return 1 if failed else 0


def seen(runs: Sequence[RunReader]) -> str:
    """A sentence for each task: what every learner returned at the step that all of them reach."""
    from tom.analysis.curves import Curve, curve_points  # here: `tom --help` lists this command
    from tom.analysis.scores import FINAL, common_step, scores_of

    by_task: dict[str, list[Curve]] = {}
    for run in sorted(runs, key=lambda run: (run.env, run.learner)):
        step, value = curve_points(run.metrics(), "eval/return")
        if len(step):
            drawn = Curve(run.run_id, run.env, run.learner, run.preset, run.seed, step, value)
            by_task.setdefault(run.env, []).append(drawn)
    sentences = []
    for env, curves in by_task.items():
        until = common_step(curves)
        of: dict[str, list[float]] = {}
        for curve, score in zip(curves, scores_of(curves, FINAL, until), strict=True):
            of.setdefault(curve.learner, []).append(float(score))
        means = sorted(((sum(of[name]) / len(of[name]), name) for name in of), reverse=True)
        words = ", ".join(f"{name} {readable.score(mean)}" for mean, name in means)
        sentences.append(f"Mean return on {env} at step {until:,.0f}: {words}.")
    if sentences and len({(run.env, run.learner) for run in runs}) == len(runs):
        sentences.append("One run of each tells no learner from another.")
    return " ".join(sentences)
