"""`tom train` with several learners or seeds: processes on a CPU, a fleet on a GPU."""

import argparse
import json
import shlex
import sys
from collections.abc import Sequence
from typing import Any, TextIO

import torch
from pydantic import ValidationError

from tom.cli.fleet_progress import FleetReport
from tom.cli.parser import DIGITS, one_line, overrides, whole_number
from tom.errors import UserError
from tom.harmless import terminal
from tom.machine.memory import REFUSING, out_of_memory, ran_out
from tom.record import RunReader, Store
from tom.training.fleet import check, train_fleet
from tom.training.plan import Trial
from tom.training.presets import default_preset
from tom.training.run import Stop

ENGINES = ("processes", "fleet")
FEWER = "give fewer learners or --seeds at a time; each goes on from its last checkpoint"


def trials_of(args: argparse.Namespace) -> list[Trial]:
    """Every learner with every seed, without duplicates. Raises UserError if one is impossible."""
    settings = overrides(args)
    if args.seeds and "seed" in settings:
        raise UserError("--seed and --seeds: give one of them")
    if args.run_id or args.resume not in (None, "auto"):
        raise UserError("--run-id and --resume RUN are for one training alone")
    seed = str(settings.pop("seed", 0))
    if (one := whole_number(seed)) is None:
        raise UserError(f"--seed {seed[:DIGITS]}: must be a whole number, 0 or more")
    seeds = args.seeds or [one]
    trials = [
        Trial(args.env, learner, seed, args.preset or default_preset(args.env, learner), settings)
        for learner in dict.fromkeys(args.learner)
        for seed in dict.fromkeys(seeds)
    ]
    for trial in trials:
        try:
            _ = trial.config
        except ValidationError as error:
            raise one_line(error) from None
    return trials


def wants_fleet(args: argparse.Namespace, trials: Sequence[Trial]) -> bool:
    """Whether the trainings form a fleet: on request, or on a GPU.

    Raises UserError if processes are asked for on a GPU.
    """
    on_gpu = any(trial.config.device != "cpu" for trial in trials)
    if on_gpu and args.engine == "processes":
        raise UserError("--engine processes is for --device cpu: on a GPU trainings are a fleet")
    return on_gpu or args.engine == "fleet"


def run_fleets(
    args: argparse.Namespace, fleets: Sequence[Sequence[Trial]], stop: Stop, *, rerun: bool
) -> int:
    """Train the fleets one after another, each with a progress display; returns the exit code.

    Reads from `args` the options that all training commands share.

    Raises UserError, before anything is trained, if some runs cannot form a fleet.
    """
    for trials in fleets:
        check(trials)
    stream = sys.stderr if args.json else sys.stdout
    rows: list[dict[str, Any]] = []
    for trials in fleets:
        results = () if stop.asked else _train(trials, args, stop, rerun, stream)
        done = [_row(trial, result) for trial, result in zip(trials, results, strict=False)]
        _say(done, stream)
        rows += done
    if args.json:
        print(json.dumps(rows))
    whole = len(rows) == sum(map(len, fleets))
    return 0 if whole and all(row["state"] == "finished" for row in rows) else 1


def _train(
    trials: Sequence[Trial], args: argparse.Namespace, stop: Stop, rerun: bool, stream: TextIO
) -> Sequence[RunReader | Exception]:
    """Train in lock-step; returns nothing if stopped at once."""
    with FleetReport(trials, stream) as report:
        try:
            return train_fleet(
                trials,
                Store(args.store),
                rerun=rerun,
                watchers=[(watcher,) for watcher in report.watchers()],
                command=shlex.join(["tom", *sys.argv[1:]]),
                stop=stop,
                accept_versions=args.accept_versions,
            )
        except KeyboardInterrupt:
            print(f"{report.label}: stopped at once, without a checkpoint", file=sys.stderr)
            return ()
        except REFUSING as error:  # in the work that they do together
            if not ran_out(error):
                raise
            print(f"{report.label}: failed: {_too_much(error)}", file=sys.stderr)
            return ()


def _too_much(error: Exception) -> str:
    on_gpu = isinstance(error, torch.OutOfMemoryError)
    return f"they do not fit the GPU: {FEWER}" if on_gpu else out_of_memory(error)


def _say(rows: Sequence[dict[str, Any]], stream: TextIO) -> None:
    for row in rows:
        returns = [row[name] for name in ("last_return", "best_return")]
        last, best = ("-" if value is None else f"{value:.1f}" for value in returns)
        after = f"{row['state']} after {row['env_step']} steps"
        print(f"{row['run_id']}: {after}, last return {last}, best {best}", file=stream)
        if row["error"]:
            print(terminal(f"{row['run_id']} failed: {row['error']}"), file=sys.stderr)


def _row(trial: Trial, result: RunReader | Exception) -> dict[str, Any]:
    row: dict[str, Any] = {
        "run_id": trial.run_id,
        "env": trial.env,
        "learner": trial.learner,
        "seed": trial.seed,
        "state": "failed",
        "env_step": None,
        "last_return": None,
        "best_return": None,
        "error": None,
    }
    if isinstance(result, Exception):
        row["error"] = out_of_memory(result) if ran_out(result) else str(result)
    if isinstance(result, RunReader):
        status = result.status
        row |= {name: getattr(status, name) for name in ("state", "env_step", "last_return")}
        row |= {"run_id": result.run_id, "best_return": status.best_return}
    return row
