"""`tom train`: one training, recorded into a run folder."""

import argparse
import json
import shlex
import signal
import sys
from typing import Any, NoReturn

from pydantic import ValidationError

from tom.cli.parser import add_config_options, add_run_options, one_line, overrides
from tom.cli.progress import ProgressReport
from tom.envs import ENV_NAMES
from tom.learners import LEARNER_NAMES
from tom.presets import PRESETS, config_type, resolve
from tom.record import RunReader, Store
from tom.run import AnyConfig, train

OWN_OPTIONS = {"env", "learner", "preset"}


def add_parser(subparsers, arguments: list[str]) -> None:
    parser = subparsers.add_parser(
        "train",
        help="train one learner in one environment",
        description="Train one learner in one environment. The settings below are those of "
        "--env (default hopper); road-and-rocks has its own: tom train --env road-and-rocks "
        "--help.",
    )
    parser.add_argument("--env", required=True, metavar="ENV", help=", ".join(ENV_NAMES))
    parser.add_argument(
        "--learner", required=True, metavar="LEARNER", help=", ".join(LEARNER_NAMES)
    )
    parser.add_argument(
        "--preset", default="paper", metavar="PRESET", help=", ".join(PRESETS) + " [paper]"
    )
    parser.add_argument("--run-id", help="name of the run folder [env-learner-seed-time]")
    add_run_options(parser)
    add_config_options(parser, config_type(_given(arguments, "--env")), leave_out=OWN_OPTIONS)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    try:
        config = resolve(args.env, args.learner, args.preset, overrides(args))
    except ValidationError as error:
        raise one_line(error) from None
    return record(config, args)


def record(config: AnyConfig, args: argparse.Namespace) -> int:
    """Run `config` under the options that every recorded run shares; the exit code."""
    store = Store(args.store)
    signal.signal(signal.SIGTERM, _interrupt)
    label = f"{config.env} {config.learner} seed {config.seed}"
    with ProgressReport(
        label, config.total_steps, sys.stderr if args.json else sys.stdout
    ) as progress:
        try:
            done = train(
                config,
                store,
                args.run_id,
                rerun=not args.no_rerun,
                watchers=(progress.consume,),
                command=shlex.join(["tom", *sys.argv[1:]]),
            )
        except KeyboardInterrupt:
            print(f"{label}: stopped", file=sys.stderr)
            return 1
    _print_summary(done, args.json)
    return 0


def summary(done: RunReader) -> dict[str, Any]:
    """What a run came to: its last and best return and where it lies."""
    status = done.status
    return {
        "run_id": done.run_id,
        "env": done.env,
        "learner": done.learner,
        "seed": done.seed,
        "state": status.state,
        "env_step": status.env_step,
        "last_return": status.last_return,
        "best_return": status.best_return,
        "path": str(done.path),
    }


def _print_summary(done: RunReader, as_json: bool) -> None:
    row = summary(done)
    if as_json:
        print(json.dumps(row))
        return
    print(
        f"{row['run_id']}: {row['state']} after {row['env_step']} steps, last return "
        f"{number(row['last_return'])}, best {number(row['best_return'])}: {row['path']}"
    )


def number(value: float | None) -> str:
    """A return for a table or a line; a dash where there was no evaluation yet."""
    return "-" if value is None else f"{value:.1f}"


def _given(arguments: list[str], option: str) -> str:
    for index, word in enumerate(arguments):
        if word.startswith(option + "="):
            return word.split("=", 1)[1]
        if word == option and index + 1 < len(arguments):
            return arguments[index + 1]
    return ""


def _interrupt(*_: object) -> NoReturn:
    raise KeyboardInterrupt
