"""`tom sweep`: many trainings; the same command resumes them after a stop."""

import argparse
import json
import os
import shlex
import signal
import sys
import time
from collections.abc import Sequence
from math import inf
from pathlib import Path
from typing import Any, TextIO

from rich.console import Group
from rich.table import Table
from rich.text import Text

from tom import readable
from tom.cli.output import Display, print_problems, show_rows, summary
from tom.cli.parser import add_accept_versions, add_json, add_training_options, overrides
from tom.envs import ANY, ENV_NAMES, import_task
from tom.envs.termination import import_rule
from tom.errors import GoneError, UserError
from tom.harmless import terminal
from tom.learners import LEARNERS
from tom.machine.processes import on_stopping
from tom.readable import whole
from tom.record import Store, checkpoint
from tom.record.thin import without_options
from tom.sweep.bucket import open_backend
from tom.sweep.driver import ATTEMPTS, Driver, Job
from tom.sweep.engine import open_engine, script
from tom.sweep.projection import cost, makespan
from tom.training.plan import Trial, checked, is_done, read_plan, same_run, trials

POLL_S = 0.5
OWN_OPTIONS = {"env", "learner", "preset", "seed", "steps"}
STATES = ("running", "elsewhere", "failed", "stopped", "waiting", "finished")
"""of a training, the most important first"""
COLUMNS = ("run", "state", "step", "of", "last return", "best return", "steps/s", "left", "note")
FRAME_LINES = 8
"""terminal lines taken by the table's frame, its head and the lines below it"""


def add_parser(subparsers, arguments: list[str]) -> None:
    parser = subparsers.add_parser(
        "sweep",
        usage="tom sweep --env ENV ... --learner LEARNER ... [--seeds N ...] [options]",
        description="Train every environment with every learner and seed. Finished runs are "
        "skipped, and broken ones continue from their checkpoint. A run that ends "
        f"{ATTEMPTS} times without progress is reported and left. Ctrl-C stops all cleanly; the "
        "same command continues.",
    )
    parser.add_argument("--env", nargs="+", metavar="ENV", help=f"{', '.join(ENV_NAMES)}, {ANY}")
    parser.add_argument("--learner", nargs="+", metavar="LEARNER", help=", ".join(LEARNERS))
    parser.add_argument(
        "--seeds", type=whole(0), nargs="+", metavar="N", help="one run per seed [0]"
    )
    parser.add_argument("--steps", type=int, metavar="N", help="env steps of each run")
    parser.add_argument("--file", type=Path, help="the same in YAML; options here override it")
    parser.add_argument(
        "--store", type=_place, default=Path("runs"), help="run store, or s3://... [runs/]"
    )
    parser.add_argument("--jobs", type=whole(1), metavar="N", help="runs at a time [one per core]")
    parser.add_argument(
        "--engine",
        choices=("local", "ray", "slurm"),
        default="local",
        help="local: processes, one per core; ray: processes on the machines of a Ray cluster; "
        "slurm: print an array script [local]",
    )
    parser.add_argument(
        "--address",
        metavar="HOST:PORT",
        help="the Ray cluster to train on [one of this machine, which ends with the sweep]",
    )
    add_accept_versions(parser)
    parser.add_argument("--only", type=whole(0), metavar="I", help="only the I-th run of the plan")
    parser.add_argument(
        "--dry-run", action="store_true", help="print what would run, its hours and disk space"
    )
    add_json(parser, "print the result as JSON")
    add_training_options(parser, arguments, leave_out=OWN_OPTIONS)
    parser.set_defaults(run=run)


def _place(text: str) -> Path | str:
    """The type of a folder or of the URL of an object store, for argparse."""
    if "://" in text and not text.startswith("s3://"):
        raise argparse.ArgumentTypeError(f"{text}: a folder or s3://BUCKET/PREFIX")
    return text if "://" in text else Path(text)


def run(args: argparse.Namespace) -> int:
    planned = _planned(args)
    jobs = args.jobs or len(os.sched_getaffinity(0))
    with open_backend(args.store, [trial.run_id for trial in planned]) as backend:
        if args.dry_run:
            return _dry_run(args, backend.store, planned, jobs)
        if args.engine == "slurm":
            words = without_options(shlex.join(sys.argv[1:]), ["--engine"])
            runs = backend.store.runs()
            hours = [one.hours for trial in planned if (one := cost(trial, runs))]
            longest = max(hours) if len(hours) == len(planned) else None
            print(script(len(planned), args.store, words, longest))
            return 0
        with open_engine(args.engine, args.address, args.jobs) as engine:
            backend.store.path.mkdir(parents=True, exist_ok=True)
            driver = Driver(backend, planned, engine, accept_versions=args.accept_versions)
            print_problems(backend.store)
            return drive(args, driver)


def _planned(args: argparse.Namespace) -> list[Trial]:
    """The requested trainings; options on the command line override the file.

    Raises UserError for options that do not go together.
    """
    content: dict[str, Any] = read_plan(args.file) if args.file else {}
    names = ("env", "learner", "seeds", "steps", "preset")
    content |= {name: getattr(args, name) for name in names if getattr(args, name) is not None}
    missing = [f"--{name}" for name in ("env", "learner") if not content.get(name)]
    if missing:
        raise UserError(f"a sweep needs {' and '.join(missing)} (or --file PLAN.yaml)")
    plan = checked(content).but(settings=overrides(args))
    for name in plan.env:
        import_task(name)
    model = plan.settings.get("model", {})
    import_rule(model.get("termination") if isinstance(model, dict) else None)
    planned = trials(plan)
    if args.address is not None and args.engine != "ray":
        raise UserError("--address is the address of a Ray cluster: add --engine ray")
    if args.engine == "ray" and any(trial.config.device != "cpu" for trial in planned):
        raise UserError("--engine ray trains on CPUs, one run per core: leave out --device")
    if args.engine == "slurm" and isinstance(args.store, str):
        raise UserError(f"--engine slurm needs a folder, and --store {args.store} is not one")
    if args.only is None:
        return planned
    if args.engine == "slurm":
        raise UserError("--only is given to each task of the array: leave it out")
    if args.only >= len(planned):
        raise UserError(f"--only {args.only}: this sweep has runs 0 to {len(planned) - 1}")
    return [planned[args.only]]


# A sweep that runs


def drive(args: argparse.Namespace, driver: Driver) -> int:
    """Run the sweep to its end with a table of its progress; returns the exit code."""
    stream = sys.stderr if args.json else sys.stdout
    with on_stopping(signal.default_int_handler), SweepDisplay(driver, stream) as display:
        try:
            while not driver.poll():
                display.update()
                time.sleep(POLL_S)
        except GoneError as error:
            display.print(str(error))
            driver.detach()
        except KeyboardInterrupt:
            display.print("stopping: every training writes a checkpoint (Ctrl-C again: at once)")
        finally:
            driver.stop()
        display.update()
    if args.json:
        print(json.dumps([_row(driver, job) for job in driver.jobs]))
    for job in driver.jobs:
        if job.state == "failed":
            text = job.note.replace("\n", "\n    ")
            log = driver.backend.keep_log(job.log)
            print(f"{job.run_id} failed: {text}\n    log: {log}", file=sys.stderr)
    states = [job.state for job in driver.jobs]
    done, failed = states.count("finished"), states.count("failed")
    print(f"{done} of {len(states)} runs finished, {failed} failed", file=stream)
    if done + failed < len(states):
        print("stopped: the same command continues", file=stream)
    if isinstance(args.store, str):
        print(f"to look at them: tom runs fetch {args.store} --store runs", file=stream)
    return 0 if done == len(states) else 1


def _row(driver: Driver, job: Job) -> dict[str, Any]:
    run = summary(driver.run_of(job))
    own = {"run_id": job.run_id, "env": job.trial.env, "learner": job.trial.learner}
    return {**run, **own, "seed": job.trial.seed, "state": job.state, "note": job.note}


class SweepDisplay(Display):
    """A live table of the trainings on a terminal; elsewhere a line for each that changed."""

    line_every_s = 30.0

    def __init__(self, driver: Driver, stream: TextIO) -> None:
        super().__init__(stream)
        self._driver = driver
        self._states: dict[str, str] = {}
        self._shown = -inf  # the first update is shown

    def update(self) -> None:
        changed = [j for j in self._driver.jobs if self._states.get(j.trial.run_id) != j.state]
        self._states |= {job.trial.run_id: job.state for job in changed}
        if not self.live:
            for job in changed:
                note = f" ({job.note.splitlines()[0]})" if job.note else ""
                self.print(terminal(f"{job.run_id}: {job.state}{note}"))
        self.refresh(now=self.live is not None and bool(changed))

    def line(self) -> str:
        states = [job.state for job in self._driver.jobs]
        parts = [f"{states.count(name)} {name}" for name in STATES if name in states]
        full = "; the disk is full: waiting for room" if self._driver.full else ""
        trouble = f"; {self._driver.trouble}" if self._driver.trouble else ""
        return ", ".join(parts) + full + trouble

    def picture(self) -> Group:
        """A table of as many runs as the terminal has lines for, the most important first."""
        table = Table(title_justify="left")
        for column in COLUMNS:
            left = column in ("run", "state", "note")
            table.add_column(column, justify="left" if left else "right", no_wrap=column != "note")
        jobs = sorted(self._driver.jobs, key=lambda job: STATES.index(job.state))
        room = max(self.console.height - FRAME_LINES, 3)
        for job in jobs[:room]:
            status = self._driver.run_of(job).status
            alive = job.state in ("running", "elsewhere")
            cells = (
                job.run_id,
                status.phase if job.state == "running" and status.phase else job.state,
                str(status.env_step),
                str(job.trial.config.total_steps),
                readable.score(status.last_return),
                readable.score(status.best_return),
                readable.number(status.env_steps_per_s),
                readable.duration(status.eta_s) if alive else "",
                job.note.partition("\n")[0][:60],
            )
            table.add_row(*(Text(terminal(cell)) for cell in cells))
        more = f", {len(jobs) - room} more not shown" if len(jobs) > room else ""
        return Group(table, Text(self.line() + more))


# A sweep that is only planned


def _dry_run(args: argparse.Namespace, store: Store, planned: Sequence[Trial], jobs: int) -> int:
    runs = store.runs()
    print_problems(store)
    rows, to_do = [], []
    for trial in planned:
        run = same_run(trial, runs)
        done = run is not None and is_done(trial.config, run)
        saved = checkpoint.newest(run.path / checkpoint.FOLDER) if run else None
        expected = None if done else cost(trial, runs, saved or 0)
        row = {
            "run": run.run_id if run else trial.run_id,
            "env": trial.env,
            "learner": trial.learner,
            "seed": trial.seed,
            "steps": trial.config.total_steps,
            "state": run.shown if run else "new",
            "hours": expected.hours if expected else None,
            "megabytes": expected.megabytes if expected else None,
            "judged by": expected.source if expected else None,
        }
        rows.append(row)
        if not done:
            to_do.append(row)
    hours = makespan([row["hours"] or 0.0 for row in to_do], jobs)
    megabytes = sum(row["megabytes"] or 0.0 for row in to_do)
    if args.json:
        print(json.dumps({"runs": rows, "hours": hours, "megabytes": megabytes}))
        return 0
    show_rows(f"{len(rows)} runs, {len(to_do)} to do", rows)
    if not to_do or any(row["hours"] is not None for row in to_do):  # else nobody knows
        print(f"about {hours:.1f} h with {jobs} at a time and {readable.size(1e6 * megabytes)}")
    if unknown := sorted({f"{r['env']} {r['learner']}" for r in to_do if r["hours"] is None}):
        print(
            f"without {', '.join(unknown)}: {args.store} has no finished run to estimate them from"
        )
    return 0
