"""`tom sweep`: many trainings; the same command resumes them after a stop."""

import argparse
import json
import os
import signal
import sys
import time
from itertools import takewhile
from pathlib import Path
from typing import Any

from tom.cli.named import add_termination
from tom.cli.parser import DEST, add_accept_versions, add_config_options, overrides, seed_number
from tom.cli.signals import on_stopping
from tom.cli.sweep.dry import dry_run, longest
from tom.cli.sweep.places import open_backend, open_engine, place, refuse_mismatch
from tom.cli.sweep.table import Watcher, job_row
from tom.cli.tables import name_problems
from tom.config import OnlineConfig, RoadConfig, merged
from tom.envs import ANY, ENV_NAMES, ROAD, bring
from tom.envs.termination import bring_rule
from tom.errors import UserError
from tom.learners import LEARNERS, with_own_settings
from tom.sweep.driver import ATTEMPTS, Driver
from tom.sweep.engine import GoneError
from tom.sweep.slurm import script
from tom.training.plan import Trial, checked, read_plan, trials
from tom.training.presets import PRESETS

POLL_S = 0.5
OWN_OPTIONS = {"env", "learner", "preset", "seed", "steps"}


def add_parser(subparsers, arguments: list[str]) -> None:
    parser = subparsers.add_parser(
        "sweep",
        usage="tom sweep --env ENV ... --learner LEARNER ... [--seeds N ...] [options]",
        description="Train every environment with every learner and seed. Runs that are done are "
        "skipped, broken ones go on from their checkpoint, and one that ends "
        f"{ATTEMPTS} times without getting further is reported and left. Ctrl-C stops all "
        "cleanly; the same command goes on.",
    )
    parser.add_argument("--env", nargs="+", metavar="ENV", help=f"{', '.join(ENV_NAMES)}, {ANY}")
    add_termination(parser)
    parser.add_argument("--learner", nargs="+", metavar="LEARNER", help=", ".join(LEARNERS))
    parser.add_argument(
        "--seeds", type=seed_number, nargs="+", metavar="N", help="a run for each of them [0]"
    )
    parser.add_argument("--steps", type=int, metavar="N", help="env steps of each run")
    parser.add_argument(
        "--preset", metavar="PRESET", help=f"{', '.join(PRESETS)} [mended for TOM, else paper]"
    )
    parser.add_argument("--file", type=Path, help="the same in YAML; options here come on top")
    parser.add_argument(
        "--store", type=place, default=Path("runs"), help="run store, or s3://... (runs/)"
    )
    parser.add_argument("--jobs", type=int, metavar="N", help="runs at a time [one a core]")
    parser.add_argument(
        "--engine",
        choices=("local", "ray", "slurm"),
        default="local",
        help="local: processes, one a core; ray: processes on the machines of a Ray cluster; "
        "slurm: print an array script [local]",
    )
    parser.add_argument(
        "--address",
        metavar="HOST:PORT",
        help="the Ray cluster to train on [one of this machine, which ends with the sweep]",
    )
    add_accept_versions(parser)
    parser.add_argument("--only", type=int, metavar="I", help="only the I-th run of the plan")
    parser.add_argument("--dry-run", action="store_true", help="what would run, hours and disk")
    parser.add_argument("--json", action="store_true", help="print the outcome as JSON")
    parser.add_argument(
        "--model", dest=DEST + "model.kind", metavar="KIND", help="short for --model.kind"
    )
    kind = RoadConfig if _named(arguments, "--env") == {ROAD} else OnlineConfig
    add_config_options(parser, with_own_settings(kind, LEARNERS), leave_out=OWN_OPTIONS)
    parser.set_defaults(run=run)


def _named(arguments: list[str], option: str) -> set[str]:
    """The words that the command line gives to an option, which takes one or more."""
    words: set[str] = set()
    for index, word in enumerate(arguments):
        if word.startswith(option + "="):
            words.add(word.split("=", 1)[1])
        elif word == option:
            words |= set(takewhile(lambda w: not w.startswith("-"), arguments[index + 1 :]))
    return words


def run(args: argparse.Namespace) -> int:
    planned, jobs = _planned(args), _jobs(args)
    on_gpu = any(trial.config.device != "cpu" for trial in planned)
    refuse_mismatch(args.engine, args.address, args.store, on_gpu)
    if args.engine == "slurm" and args.only is not None:
        raise UserError("--only is given to each task of the array: leave it out")
    with open_backend(args.store, planned) as backend:
        if args.dry_run:
            return dry_run(args, backend.store, planned, jobs)
        if args.engine == "slurm":
            print(script(planned, args.store, _own_words(), longest(backend.store, planned)))
            return 0
        with open_engine(args.engine, args.address, args.jobs) as engine:
            backend.store.ensure_writable()
            driver = Driver(backend, planned, engine, accept_versions=args.accept_versions)
            name_problems(backend.store)
            return drive(args, driver)


def _planned(args: argparse.Namespace) -> list[Trial]:
    """The requested trainings; options on the command line override the file."""
    content: dict[str, Any] = read_plan(args.file) if args.file else {}
    names = ("env", "learner", "seeds", "steps", "preset")
    content |= {name: getattr(args, name) for name in names if getattr(args, name) is not None}
    held = content.get("settings", {})
    if isinstance(held, dict):  # anything else is an error that `checked` reports
        content["settings"] = merged(held, overrides(args))
    missing = [f"--{name}" for name in ("env", "learner") if not content.get(name)]
    if missing:
        raise UserError(f"a sweep needs {' and '.join(missing)} (or --file PLAN.yaml)")
    plan = checked(content)
    for name in plan.env:
        bring(name)
    held = plan.settings.get("model", {})
    bring_rule(held.get("termination") if isinstance(held, dict) else None)
    planned = trials(plan)
    if args.only is None:
        return planned
    if not 0 <= args.only < len(planned):
        raise UserError(f"--only {args.only}: this sweep has runs 0 to {len(planned) - 1}")
    return [planned[args.only]]


def _jobs(args: argparse.Namespace) -> int:
    if args.jobs is not None and args.jobs < 1:
        raise UserError(f"--jobs {args.jobs}: must be at least 1")
    return args.jobs or len(os.sched_getaffinity(0))


def drive(args: argparse.Namespace, driver: Driver) -> int:
    """Run the sweep to its end with a table of its progress; returns the exit code."""
    stream = sys.stderr if args.json else sys.stdout
    with on_stopping(signal.default_int_handler), Watcher(driver, stream) as watcher:
        try:
            while not driver.poll():
                watcher.look()
                time.sleep(POLL_S)
        except GoneError as error:
            watcher.say(str(error))
            driver.let_go()
        except KeyboardInterrupt:
            watcher.say("stopping: every training writes a checkpoint (Ctrl-C again: at once)")
        finally:
            driver.stop()
        watcher.look()
    return _report(args, driver)


def _report(args: argparse.Namespace, driver: Driver) -> int:
    states = [job.state for job in driver.jobs]
    if args.json:
        print(json.dumps([job_row(driver, job) for job in driver.jobs]))
    failed = [job for job in driver.jobs if job.state == "failed"]
    for job in failed:
        text = job.note.replace("\n", "\n    ")
        print(
            f"{job.run_id} failed: {text}\n    log: {driver.backend.keep_log(job.log)}",
            file=sys.stderr,
        )
    done = states.count("finished")
    stream = sys.stderr if args.json else sys.stdout
    print(f"{done} of {len(states)} runs finished, {len(failed)} failed", file=stream)
    if done + len(failed) < len(states):
        print("stopped: the same command goes on", file=stream)
    if isinstance(args.store, str):
        print(f"to look at them: tom runs fetch {args.store} --store runs", file=stream)
    return 0 if done == len(states) else 1


def _own_words() -> list[str]:
    """The words of this command, which each task of a Slurm array repeats."""
    words = [word for word in sys.argv[1:] if word not in ("--engine=slurm", "--dry-run")]
    while "--engine" in words:
        at = words.index("--engine")
        del words[at : at + 2]
    return words
