"""Options and helpers that the commands of `tom reproduce` share."""

import argparse
import json
import os
import shlex
import signal
import sys
from collections.abc import Callable, Sequence
from concurrent.futures.process import BrokenProcessPool
from functools import partial
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from tom.cli.parser import SEEDS, folder, one_line
from tom.cli.progress import ProgressReport
from tom.cli.signals import on_stopping
from tom.cli.tables import show
from tom.config import SacRecordingConfig
from tom.envs import ENVS, task
from tom.errors import DivergedError, UserError, unknown
from tom.record import RunReader, Store
from tom.record.files import plain
from tom.studies.checks import Check
from tom.studies.progression import SAC_SEEDS, recorded, recording_config
from tom.training.presets import PRESETS
from tom.training.resume import resume, unfinished
from tom.training.run import Stop, train


class Distinct(argparse.Action):
    """Stores an option's values, each once: a seed that is named twice is no second one."""

    def __call__(self, parser, namespace, values, option_string=None) -> None:
        setattr(namespace, self.dest, list(dict.fromkeys(values or ())))


def add_output(parser: argparse.ArgumentParser, name: str) -> None:
    """Add `--out` and `--json`: where the report of study `name` is written."""
    parser.add_argument("--out", type=Path, default=Path("reports") / name, help="[%(default)s]")
    parser.add_argument("--json", action="store_true", help="print the result as JSON")


def add_store(parser: argparse.ArgumentParser) -> None:
    """Add `--store`."""
    parser.add_argument("--store", type=folder, default=Path("runs"), help="run store (runs/)")


def add_jobs(parser: argparse.ArgumentParser) -> None:
    """Add `--jobs`: how many cases are computed at a time."""
    cores = len(os.sched_getaffinity(0))
    parser.add_argument("--jobs", type=int, default=cores, help="cases at a time [one a core]")


def add_recordings(parser: argparse.ArgumentParser) -> None:
    """Add the options that choose recordings of SAC and the learners' seeds."""
    parser.add_argument("--env", nargs="+", default=list(SAC_SEEDS), metavar="ENV")
    parser.add_argument("--steps", type=int, default=50_000, help="steps of SAC [50000]")
    parser.add_argument(
        "--seeds",
        nargs="+",
        type=int,
        action=Distinct,
        default=[0, 1, 2],
        help="TOM's [0 1 2]",
    )
    add_store(parser)
    add_jobs(parser)


def add_stored(parser: argparse.ArgumentParser, *, several: bool = False) -> None:
    """Add the options that choose runs of the store, of one preset or of `several`."""
    parser.add_argument("--env", nargs="+", default=list(ENVS), metavar="ENV", help="[all of ours]")
    parser.add_argument(
        "--preset", nargs="+" if several else 1, metavar="PRESET",
        default=["paper", "mended"] if several else ["paper"],
        help="[paper mended]: runs of the first are called by their learner alone, those of others "
        "by both" if several else "[paper]",
    )  # fmt: skip
    add_store(parser)


def check_recordings(args: argparse.Namespace) -> None:
    """Raises UserError if the values of `add_recordings` or the SAC seeds are impossible."""
    if args.steps < 1000:
        raise UserError("--steps must be at least 1000")
    for env in tasks(args.env):
        try:
            recording_config(env, 0, args.steps)
        except ValidationError as error:
            raise one_line(error) from None
    check_seeds(args.jobs, [*args.seeds, *(getattr(args, "sac_seeds", None) or ())])


def check_seeds(jobs: int, seeds: Sequence[int]) -> None:
    """Raises UserError if a seed or the number of jobs is impossible."""
    if min(seeds) < 0 or max(seeds) >= SEEDS or jobs < 1:
        raise UserError(f"seeds must be at least 0 and less than {SEEDS}, and --jobs at least 1")


def check_stored(args: argparse.Namespace) -> list[str]:
    """The names of the chosen tasks. Raises UserError for an unknown task or preset."""
    for preset in args.preset:
        if preset not in PRESETS:
            raise unknown("preset", preset, PRESETS)
    return tasks(args.env)


def tasks(envs: Sequence[str]) -> list[str]:
    """The names of the tasks, each once. Raises UserError for an unknown one."""
    return list(dict.fromkeys(task(env).name for env in envs))


def print_json(content: dict[str, Any]) -> None:
    """Print one line of strict JSON: no NaN, no arrays."""
    print(json.dumps(plain(content), allow_nan=False))


def show_checks(title: str, checks: Sequence[Check]) -> None:
    """Print an acceptance as a table."""
    rows = [(c.name, f"{c.value:.3g}", c.bound, "yes" if c.met else "NO") for c in checks]
    show(title, ("figure", "value", "bound", "met"), rows)


def out_folder(path: Path) -> None:
    """Make the folder of a report. Raises UserError if it cannot be made."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"cannot make {path}: {error.strerror}; name another --out") from error


def stoppable(work: Callable[[argparse.Namespace], int]) -> Callable[[argparse.Namespace], int]:
    """`work`, but with one line and exit code 1 on Ctrl-C, SIGTERM, or if a case cannot be
    finished (a process was killed, the disk is full, a loss is not finite)."""

    def run(args: argparse.Namespace) -> int:
        try:
            with on_stopping(signal.default_int_handler, [signal.SIGTERM]):
                return work(args)
        except KeyboardInterrupt:
            say("stopped")
        except BrokenProcessPool:
            say("a process was killed; fewer --jobs need less memory. The same command goes on")
        except OSError as error:
            say(f"{error}. The same command goes on")
        except DivergedError as error:
            say(f"failed: {error}")
        return 1

    return run


def sac_recordings(
    store: Store, envs: Sequence[str], seeds: Sequence[int] | None, steps: int
) -> list[RunReader]:
    """The recordings of every task and SAC seed (default: the study's); missing ones are made."""
    configs = [
        recording_config(env, seed, steps)
        for env in tasks(envs)
        for seed in seeds or SAC_SEEDS.get(env, (0,))
    ]
    return [recorded(store, config) or _record(store, config) for config in configs]


def say(line: str) -> None:
    """Print a line of progress to stderr, so that stdout stays readable for a script."""
    print(line, file=sys.stderr, flush=True)


def _record(store: Store, config: SacRecordingConfig) -> RunReader:
    """Make a recording, or go on with one that was stopped; a signal stops it with a checkpoint."""
    stop, begun = Stop(), unfinished(store, config)
    work = partial(resume, store, begun) if begun else partial(train, config, store)
    label = f"{config.env} sac seed {config.seed}"
    with on_stopping(stop), ProgressReport(label, config.total_steps, sys.stderr) as progress:
        command = shlex.join(["tom", *sys.argv[1:]])
        run = work(watchers=(progress.consume,), rerun=False, command=command, stop=stop)
    if stop.asked:
        raise KeyboardInterrupt
    return run
