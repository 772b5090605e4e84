"""`tom train`: one training, in its own run folder."""

import argparse
import sys
from collections.abc import Callable, Sequence
from contextlib import closing
from functools import partial
from typing import Any

from tom.cli.output import ProgressReport, print_result, summary
from tom.cli.parser import add_run_options, add_training_options, named, overrides
from tom.data.card import sentence
from tom.envs import ANY, ENV_NAMES
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
from tom.machine.memory import MEMORY_ERRORS, is_out_of_memory, out_of_memory
from tom.machine.processes import on_stopping
from tom.readable import score
from tom.record import RunReader, Store, checkpoint, lock, manage
from tom.record.files import size_of
from tom.record.task_record import card_of
from tom.record.versions import command
from tom.training.plan import is_done, steps_beyond
from tom.training.presets import resolve
from tom.training.resume import find_unfinished, resumable_config, resume
from tom.training.run import AnyConfig, Stop, train

OWN_OPTIONS = ("env", "learner", "preset")


def add_parser(subparsers, arguments: list[str]) -> None:
    parser = subparsers.add_parser(
        "train",
        usage="tom train --env ENV --learner LEARNER [options]",
        description="Train one learner in one environment; `tom sweep` trains many. The settings "
        "below are those of --env (default hopper); road-and-rocks has its own: "
        "tom train --env road-and-rocks --help.",
    )
    begins = not named(arguments, "--resume")
    parser.add_argument(
        "--env", required=begins, metavar="ENV", help=f"{', '.join(ENV_NAMES)}, {ANY}"
    )
    parser.add_argument("--learner", required=begins, metavar="LEARNER", help=", ".join(LEARNERS))
    parser.add_argument(
        "--resume",
        metavar="RUN|auto",
        help="continue a run from its last checkpoint (with --steps: to that step); auto: the "
        "newest incomplete run of this same command, or of fewer steps, else a new one",
    )
    parser.add_argument("--run-id", help="name of the run folder [env-learner-seed-time]")
    add_run_options(parser)
    add_training_options(parser, arguments, leave_out=set(OWN_OPTIONS))
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    settings = overrides(args)
    if args.resume and args.resume != "auto":
        return resume_run(args, args.resume, _new_steps(args, settings))
    if not (args.env and args.learner):
        raise UserError("--resume auto needs the --env and --learner of the run")
    return start_training(resolve(args.env, args.learner, args.preset, settings), args)


def start_training(config: AnyConfig, args: argparse.Namespace) -> int:
    """Train `config`; with `--resume auto`, resume the run of an earlier same command.

    If that command named its run, it is about this run alone, and may be given as often as one
    likes: it is done once the run is, and a run that can never go on goes to the trash and begins
    anew. Raises TryLaterError if another process has it.
    """
    if not args.resume:
        return record(config, args)
    store = Store(args.store)
    if args.run_id is None:
        unfinished = find_unfinished(store, config)
        return resume_run(args, unfinished, config.steps) if unfinished else record(config, args)
    run = RunReader(store.resolve(args.run_id))
    beyond = steps_beyond(config, run)
    if beyond is None:
        return record(config, args)  # refused if another training has the name
    if is_done(config, run):
        _print_summary(run, args)
        return 0
    try:
        if checkpoint.load(run.path / checkpoint.FOLDER) is not None:
            return resume_run(args, run.run_id, config.steps + max(beyond, 0))
    except StartAgainError as error:
        print(error, file=sys.stderr)
    with closing(lock.acquire(run.path)):
        place = manage.into_trash(store, run.path)
    print(f"{run.run_id}: started from scratch; the old folder is in {place}", file=sys.stderr)
    return record(config, args)


def record(config: AnyConfig, args: argparse.Namespace) -> int:
    """Train `config` with the options of `add_run_options`; returns the exit code."""
    return _run_with_progress(args, config, partial(train, config, Store(args.store), args.run_id))


def resume_run(args: argparse.Namespace, run_id: str, steps: str | int | None) -> int:
    """Go on with a run, to its own last step or to `steps`; returns the exit code."""
    store = Store(args.store)
    run = store.run(run_id)
    config, found = resumable_config(run), (run.status.best_return, run.status.last_return)
    if steps is not None:
        config = config.but(steps=steps)
    going_on = partial(resume, store, run_id, config.steps, accept_versions=args.accept_versions)
    returns = [value for value in found if value is not None]
    return _run_with_progress(args, config, going_on, returns)


def _run_with_progress(
    args: argparse.Namespace,
    config: AnyConfig,
    training: Callable[..., RunReader],
    returns: Sequence[float] = (),
) -> int:
    """Run `train` or `resume`, which a signal stops cleanly; returns the exit code."""
    stream = sys.stderr if args.json else sys.stdout
    label, stop = f"{config.env} {config.learner} seed {config.seed}", Stop()
    with on_stopping(stop), ProgressReport(label, config.total_steps, stream, returns) as progress:
        try:
            done = training(
                rerun=not args.no_rerun,
                watchers=(progress.consume,),
                command=command(),
                stop=stop,
            )
        except KeyboardInterrupt:
            print(f"{label}: stopped at once, without a checkpoint", file=sys.stderr)
            return FAILED
        except (DivergedError, OwnCodeError, OSError) as error:
            print(f"{label}: failed: {error}", file=sys.stderr)
            # An OSError is of its disk or of another writer: another attempt may succeed.
            return TRY_LATER if isinstance(error, OSError) else FAILED
        except MEMORY_ERRORS as error:
            if not is_out_of_memory(error):
                raise
            print(f"{label}: failed: {out_of_memory(error)}", file=sys.stderr)
            return FAILED
    _print_summary(done, args)
    return 0 if done.status.state == "finished" else FAILED


def _new_steps(args: argparse.Namespace, settings: dict[str, Any]) -> str | None:
    """The number of steps, all that may change when a run is resumed by its name.

    Raises UserError for other options that differ from what the run was made with.
    """
    if args.run_id is not None:
        raise UserError(f"--resume {args.resume} already names the run: leave out --run-id")
    recorded = Store(args.store).run(args.resume)
    rule = settings.get("model", {}).pop("termination", None)  # named only to be imported
    own_rule = recorded.given.get("model", {}).get("termination")
    for option, value, own in (
        ("--env", args.env, recorded.env),
        ("--learner", args.learner, recorded.learner),
        ("--preset", args.preset, recorded.preset),
        ("--termination", rule, own_rule),
    ):
        if value not in (None, own):
            raise UserError(
                f"{option} {value}: run '{args.resume}' was made with {own} and continues with it: "
                f"leave out {option}"
            )
    if {name for name, value in settings.items() if value != {}} - {"steps"}:
        raise UserError("--resume takes only --steps: a run continues with its own settings")
    return settings.get("steps")


def _print_summary(run: RunReader, args: argparse.Namespace) -> None:
    row = summary(run)
    row["bytes"] = size_of(run.path)
    row["checkpoint_bytes"] = size_of(run.path / checkpoint.FOLDER)
    card = {} if args.json else card_of(run)
    shown = [
        f"{row['run_id']}: {row['state']} after {row['env_step']} steps, last return "
        f"{score(row['last_return'])}, best {score(row['best_return'])}: {row['path']}",
        *([sentence(card)] if card else []),
    ]
    print_result(args, row, shown)
    if run.status.state == "failed" and not args.json:
        print(f"failed: {terminal(run.status.reason)}", file=sys.stderr)
