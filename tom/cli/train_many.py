"""`tom train` with several learners or seeds: processes on a CPU, a fleet on a GPU."""

import argparse
import json
import shlex
import sys
from collections.abc import Callable, Sequence
from typing import Any

from pydantic import ValidationError

from tom.cli.parser import one_line, overrides
from tom.cli.progress import ProgressReport
from tom.errors import UserError
from tom.events import Evaluation, Event, Notice, Tick
from tom.fleet import check, train_fleet
from tom.record import RunReader, Store
from tom.run import Stop
from tom.sweep.plan import Trial

ENGINES = ("processes", "fleet")
Drive = Callable[[Store, Sequence[Trial]], int]


def trials_of(args: argparse.Namespace) -> list[Trial]:
    """Every learner with every seed, each once. Raises UserError where one is impossible."""
    settings = overrides(args)
    if args.seeds and "seed" in settings:
        raise UserError("--seed and --seeds: give one of them")
    if args.run_id or args.resume not in (None, "auto"):
        raise UserError("--run-id and --resume RUN are for one training alone")
    seeds = args.seeds or [int(settings.pop("seed", 0))]
    settings.pop("seed", None)
    found = [
        Trial(args.env, learner, seed, args.preset, settings)
        for learner in dict.fromkeys(args.learner)
        for seed in dict.fromkeys(seeds)
    ]
    for trial in found:
        try:
            _ = trial.config
        except ValidationError as error:
            raise one_line(error) from None
    return found


def wants_fleet(args: argparse.Namespace, trials: Sequence[Trial]) -> bool:
    """Whether they are to be a fleet: where it is asked for, or on a GPU."""
    on_gpu = any(trial.config.device != "cpu" for trial in trials)
    if on_gpu and args.engine == "processes":
        raise UserError("--engine processes is for --device cpu: on a GPU trainings are a fleet")
    return on_gpu or args.engine == "fleet"


def run_fleet(args: argparse.Namespace, trials: Sequence[Trial], stop: Stop) -> int:
    """Train them in lock-step, with one report of progress; the exit code."""
    check(trials)
    stream = sys.stderr if args.json else sys.stdout
    label = f"{args.env}, {len(trials)} in a fleet"
    with ProgressReport(label, trials[0].config.total_steps, stream) as progress:
        shown = _Shown(progress)
        try:
            results = train_fleet(
                trials,
                Store(args.store),
                rerun=not args.no_rerun,
                watchers=[(shown.consume,) for _ in trials],
                command=shlex.join(["tom", *sys.argv[1:]]),
                stop=stop,
            )
        except KeyboardInterrupt:
            print(f"{label}: stopped at once, without a checkpoint", file=sys.stderr)
            return 1
    return _report(args, trials, results)


class _Shown:
    """Passes on what one report of a whole fleet can show."""

    def __init__(self, progress: ProgressReport) -> None:
        self._progress = progress
        self._step = 0

    def consume(self, event: Event) -> None:
        newest = isinstance(event, Tick) and event.env_step > self._step
        if newest or isinstance(event, Evaluation | Notice):
            self._step = max(self._step, event.env_step)
            self._progress.consume(event)


def _report(
    args: argparse.Namespace, trials: Sequence[Trial], results: Sequence[RunReader | Exception]
) -> int:
    rows = [_row(trial, found) for trial, found in zip(trials, results, strict=True)]
    if args.json:
        print(json.dumps(rows))
    for row in () if args.json else rows:
        returns = [row[name] for name in ("last_return", "best_return")]
        last, best = ("-" if value is None else f"{value:.1f}" for value in returns)
        after = f"{row['state']} after {row['env_step']} steps"
        print(f"{row['run_id']}: {after}, last return {last}, best {best}")
    for row in rows:
        if row["error"]:
            print(f"{row['run_id']} failed: {row['error']}", file=sys.stderr)
    return 0 if all(row["state"] == "finished" for row in rows) else 1


def _row(trial: Trial, found: RunReader | Exception) -> dict[str, Any]:
    row: dict[str, Any] = {
        "run_id": trial.run_id,
        "env": trial.env,
        "learner": trial.learner,
        "seed": trial.seed,
        "state": "failed",
        "env_step": None,
        "last_return": None,
        "best_return": None,
        "error": str(found) if isinstance(found, Exception) else None,
    }
    if isinstance(found, RunReader):
        status = found.status
        row |= {name: getattr(status, name) for name in ("state", "env_step", "last_return")}
        row |= {"run_id": found.run_id, "best_return": status.best_return}
    return row
