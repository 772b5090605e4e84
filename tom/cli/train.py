"""`tom train`: one training, or one for each learner and seed, each in its own run folder."""

import argparse
import json
import os
import shlex
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from tom.cli.named import add_termination
from tom.cli.parser import (
    DEST,
    add_config_options,
    add_run_options,
    one_line,
    overrides,
    seed_number,
)
from tom.cli.progress import ProgressReport
from tom.cli.signals import on_stopping
from tom.cli.sweep import drive
from tom.cli.tables import summary
from tom.envs import ANY, ENV_NAMES, ROAD
from tom.errors import (
    FAILED,
    TRY_LATER,
    DivergedError,
    OwnCodeError,
    StartAgainError,
    UserError,
)
from tom.harmless import terminal
from tom.learners import LEARNERS
from tom.machine.memory import REFUSING, out_of_memory, ran_out
from tom.readable import percent, score, size
from tom.record import RunReader, Store, checkpoint, manage
from tom.record.files import size_of
from tom.record.lock import BusyError
from tom.record.writer import TakenError
from tom.sweep.backend import FolderBackend
from tom.sweep.driver import Driver
from tom.sweep.engine import LocalEngine
from tom.training.plan import Trial, is_done, steps_beyond
from tom.training.presets import PRESETS, config_type, default_preset, resolve
from tom.training.resume import recorded_config, resume, unfinished
from tom.training.run import AnyConfig, Stop, train

OWN_OPTIONS = ("env", "learner", "preset")


def add_parser(subparsers, arguments: list[str]) -> None:
    parser = subparsers.add_parser(
        "train",
        usage="tom train --env ENV --learner LEARNER [options]",
        description="Train one learner in one environment, or several learners and seeds at once. "
        "The settings below are those of --env (default hopper); road-and-rocks has its own: "
        "tom train --env road-and-rocks --help.",
    )
    goes_on = any(word.split("=")[0] == "--resume" for word in arguments)
    parser.add_argument(
        "--env", required=not goes_on, metavar="ENV", help=f"{', '.join(ENV_NAMES)}, {ANY}"
    )
    parser.add_argument(
        "--learner",
        nargs="+",
        required=not goes_on,
        metavar="LEARNER",
        help=f"one or more of {', '.join(LEARNERS)}",
    )
    parser.add_argument(
        "--seeds", nargs="+", type=seed_number, metavar="N",
        help="a training for each of these seeds, one a core",
    )  # fmt: skip
    parser.add_argument(
        "--preset", metavar="PRESET", help=f"{', '.join(PRESETS)} [mended for TOM, else paper]"
    )
    parser.add_argument(
        "--model", dest=DEST + "model.kind", metavar="KIND", help="short for --model.kind"
    )
    parser.add_argument(
        "--resume",
        metavar="RUN|auto",
        help="go on with a run from its last checkpoint (with --steps: to that step); auto: the "
        "newest run of this very command, or of fewer steps, that is not complete; else a new one",
    )
    parser.add_argument("--run-id", help="name of the run folder [env-learner-seed-time]")
    if _given(arguments, "--env") != ROAD:
        add_termination(parser)
    add_run_options(parser)
    settings = config_type(_given(arguments, "--env"), *LEARNERS)
    add_config_options(parser, settings, leave_out=set(OWN_OPTIONS))
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    given = overrides(args)
    if args.resume and args.resume != "auto":
        _refuse_others(args)
        return _resume(args, args.resume, _steps(_without_rule(given, args.resume, args.store)))
    if not (args.env and args.learner):
        raise UserError("--resume auto needs the --env and --learner of the run")
    if len(args.learner) > 1 or args.seeds:
        return _train_many(args)
    try:
        config = resolve(args.env, args.learner[0], args.preset, given)
    except ValidationError as error:
        raise one_line(error) from None
    return begin(config, args)


def begin(config: AnyConfig, args: argparse.Namespace) -> int:
    """Train `config`; with `--resume auto`, resume the run of an earlier same command.

    If that command named its run, it is about this run alone, and may be given as often as one
    likes: it is done once the run is, and a run that can never go on goes to the trash and begins
    anew. Raises TryLaterError if another process has it.
    """
    if not args.resume:
        return record(config, args)
    if args.run_id is not None:
        return _begin_named(config, args)
    if begun := unfinished(Store(args.store), config):
        return _resume(args, begun, config.steps)
    return record(config, args)


def _begin_named(config: AnyConfig, args: argparse.Namespace) -> int:
    store = Store(args.store)
    run = RunReader(store.resolve(args.run_id))
    there, beyond = run.path.is_dir(), steps_beyond(config, run)
    if there and beyond is None:
        return record(config, args)  # refused: another training has the name
    if is_done(config, run):
        _print_summary(run, args.json)
        return 0
    try:
        if unfinished(store, config, run_id=run.run_id):
            return _resume(args, run.run_id, config.steps + max(beyond or 0, 0))
        if there:
            _make_room(store, run)
    except StartAgainError as error:
        print(error, file=sys.stderr)
        _make_room(store, run, hopeless=True)
    except UserError as error:
        if there and not run.path.is_dir():
            raise BusyError(f"run '{run.run_id}' was moved away by another process") from error
        raise
    try:
        return record(config, args)
    except TakenError as error:
        raise BusyError(f"run '{run.run_id}' was just begun by another process") from error


def _make_room(store: Store, run: RunReader, hopeless: bool = False) -> None:
    """Trash a run that cannot go on and keeps its name taken: `hopeless`, or without checkpoint."""
    with manage.unwritten(run), manage.refused(f"cannot trash run '{run.run_id}'"):
        if not hopeless and checkpoint.load(run.path / checkpoint.FOLDER) is not None:
            raise BusyError(f"run '{run.run_id}' was being written by another process: try again")
        place = manage.into_trash(store, run.path)
    print(f"{run.run_id}: began anew; what was there is in {place}", file=sys.stderr)


def _train_many(args: argparse.Namespace) -> int:
    trials, store = _trials(args), Store(args.store)
    store.ensure_writable()
    engine = LocalEngine(len(os.sched_getaffinity(0)))
    home = FolderBackend(store)
    return drive(args, Driver(home, trials, engine, accept_versions=args.accept_versions))


def _trials(args: argparse.Namespace) -> list[Trial]:
    """Every learner with every seed, without duplicates. Raises UserError if one is impossible."""
    settings = overrides(args)
    if args.seeds and "seed" in settings:
        raise UserError("--seed and --seeds: give one of them")
    if args.run_id or args.resume not in (None, "auto"):
        raise UserError("--run-id and --resume RUN are for one training alone")
    seed = str(settings.pop("seed", 0))
    if not seed.isdecimal():
        raise UserError(f"--seed {seed}: must be a whole number, 0 or more")
    seeds = args.seeds or [int(seed)]
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


def record(config: AnyConfig, args: argparse.Namespace) -> int:
    """Train `config` with the options shared by all training commands; returns the exit code."""
    store = Store(args.store)
    return _watched(args, config, lambda **options: train(config, store, args.run_id, **options))


def _resume(args: argparse.Namespace, run_id: str, given: str | int | None = None) -> int:
    """Go on with a run, to the step that is `given`."""
    store = Store(args.store)
    config = recorded_config(store.run(run_id))
    if given is not None:
        try:
            config = config.but(steps=given)
        except ValidationError as error:
            raise one_line(error) from None
    steps = None if given is None else config.steps
    accepted = args.accept_versions
    return _watched(
        args,
        config,
        lambda **options: resume(store, run_id, steps, accept_versions=accepted, **options),
    )


def _watched(
    args: argparse.Namespace, config: AnyConfig, training: Callable[..., RunReader]
) -> int:
    """Run `training` with progress on the terminal; a signal stops it cleanly."""
    stop = Stop()
    label = f"{config.env} {config.learner} seed {config.seed}"
    stream = sys.stderr if args.json else sys.stdout
    with on_stopping(stop), ProgressReport(label, config.total_steps, stream) as progress:
        try:
            done = training(
                rerun=not args.no_rerun,
                watchers=(progress.consume,),
                command=shlex.join(["tom", *sys.argv[1:]]),
                stop=stop,
            )
        except KeyboardInterrupt:
            print(f"{label}: stopped at once, without a checkpoint", file=sys.stderr)
            return 1
        except (DivergedError, OwnCodeError, OSError) as error:
            print(f"{label}: failed: {error}", file=sys.stderr)
            # An OSError is of its disk or of another writer: another attempt may succeed.
            return TRY_LATER if isinstance(error, OSError) else FAILED
        except REFUSING as error:
            if not ran_out(error):
                raise
            print(f"{label}: failed: {out_of_memory(error)}", file=sys.stderr)
            return 1
    _print_summary(done, args.json)
    return 0 if done.status.state == "finished" else 1


def _refuse_others(args: argparse.Namespace) -> None:
    """Raises UserError for options that have no meaning when a named run is resumed."""
    for option in ("seeds", "run_id"):
        if getattr(args, option) is not None:
            name = option.replace("_", "-")
            raise UserError(
                f"--resume {args.resume} goes on with that run alone: leave out --{name}"
            )
    recorded = Store(args.store).run(args.resume).config
    for option in OWN_OPTIONS:
        given, own = getattr(args, option), recorded.get(option)
        if given not in (None, own, [own]):
            given = " ".join(given) if isinstance(given, list) else given
            raise UserError(
                f"--{option} {given}: run '{args.resume}' was made with {own} and goes on with it: "
                f"leave out --{option}"
            )


def _without_rule(given: dict[str, Any], run_id: str, store: Path) -> dict[str, Any]:
    """`given` without the termination rule, which is named only to be imported, not changed."""
    name = given.get("model", {}).get("termination")
    if name is None:
        return given
    config = Store(store).run(run_id).config.get("config", {})
    recorded = config.get("model", {}).get("termination")
    if name != recorded:
        raise UserError(f"--termination {name}: run '{run_id}' was made with {recorded or 'none'}")
    rest = {key: value for key, value in given["model"].items() if key != "termination"}
    return {**given, "model": rest} if rest else {k: v for k, v in given.items() if k != "model"}


def _steps(given: dict[str, Any]) -> str | None:
    """The number of steps, the only setting that may change when a run is resumed."""
    if set(given) - {"steps"}:
        raise UserError("--resume takes --steps alone: a run goes on with its own settings")
    return given.get("steps")


def _print_summary(done: RunReader, as_json: bool) -> None:
    row = summary(done)
    row["bytes"] = size_of(done.path)
    row["checkpoint_bytes"] = size_of(done.path / checkpoint.FOLDER)
    if as_json:
        print(json.dumps(row))
        return
    print(
        f"{row['run_id']}: {row['state']} after {row['env_step']} steps, last return "
        f"{score(row['last_return'])}, best {score(row['best_return'])}: {terminal(row['path'])}"
    )
    print(
        f"on disk: {size(row['bytes'])}, {size(row['checkpoint_bytes'])} of it "
        f"checkpoints, which took {percent(checkpoint_share(done))} of the time"
    )
    if done.status.state == "failed":
        print(f"failed: {terminal(done.status.reason)}", file=sys.stderr)


def checkpoint_share(done: RunReader) -> float:
    """The share of a run's time that was spent on checkpoints."""
    table = done.metrics()
    known = {"time/checkpoint_s", "time/wall_s"} <= set(table) and len(table) > 0
    spent, wall = (
        float(np.nanmax(table[name].to_numpy(float))) if known else 0.0
        for name in ("time/checkpoint_s", "time/wall_s")
    )
    return spent / wall if wall > 0 else 0.0


def _given(arguments: list[str], option: str) -> str:
    for index, word in enumerate(arguments):
        if word.startswith(option + "="):
            return word.split("=", 1)[1]
        if word == option and index + 1 < len(arguments):
            return arguments[index + 1]
    return ""
