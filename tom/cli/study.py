"""What the commands of `tom reproduce` share."""

import argparse
import signal
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

from tom.cli.progress import ProgressReport
from tom.config import SacRecordingConfig
from tom.envs import task
from tom.errors import UserError
from tom.record import RunReader, Store
from tom.run import train
from tom.studies.progression import SAC_SEEDS, recorded, recording_config


def out_folder(path: Path) -> None:
    """Make the folder of a report. Raises UserError when it cannot be made."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"cannot make {path}: {error.strerror}; name another --out") from error


def stoppable(work: Callable[[argparse.Namespace], int]) -> Callable[[argparse.Namespace], int]:
    """`work` that ends with one line and exit code 1 on Ctrl-C and on SIGTERM."""

    def run(args: argparse.Namespace) -> int:
        signal.signal(signal.SIGTERM, signal.default_int_handler)
        try:
            return work(args)
        except KeyboardInterrupt:
            say("stopped")
            return 1

    return run


def sac_recordings(
    store: Store, envs: Sequence[str], seeds: Sequence[int] | None, steps: int
) -> list[RunReader]:
    """The recordings of every task and SAC seed (default: the study's), made where missing."""
    configs = [
        recording_config(env, seed, steps)
        for env in (task(name).name for name in envs)
        for seed in seeds or SAC_SEEDS.get(env, (0,))
    ]
    return [recorded(store, config) or _record(store, config) for config in configs]


def say(line: str) -> None:
    """A line of progress, kept out of what a script reads."""
    print(line, file=sys.stderr, flush=True)


def _record(store: Store, config: SacRecordingConfig) -> RunReader:
    label = f"{config.env} sac seed {config.seed}"
    with ProgressReport(label, config.total_steps, sys.stderr) as progress:
        return train(config, store, watchers=(progress.consume,), rerun=False)
