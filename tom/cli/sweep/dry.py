"""`tom sweep --dry-run`: the trainings that would run, with their hours and gigabytes."""

import argparse
import json
import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tom import readable
from tom.cli.tables import name_problems, show
from tom.record import RunReader, Store, checkpoint
from tom.sweep.projection import Cost, cost, makespan
from tom.training.plan import Trial, is_done, same_run


def dry_run(args: argparse.Namespace, store: Store, planned: Sequence[Trial], jobs: int) -> int:
    """Print the trainings that would run; returns the exit code."""
    runs = store.runs()
    name_problems(store)
    existing = [same_run(trial, runs) for trial in planned]
    costs = [
        None if _finished(trial, run) else _cost(trial, runs, run)
        for trial, run in zip(planned, existing, strict=True)
    ]
    rows = [_row(*each) for each in zip(planned, existing, costs, strict=True)]
    todo = [
        row
        for row, trial, run in zip(rows, planned, existing, strict=True)
        if not _finished(trial, run)
    ]
    hours = makespan([row["hours"] or 0.0 for row in todo], jobs)
    disk = sum(row["megabytes"] or 0.0 for row in todo)
    if args.json:
        print(json.dumps({"runs": rows, "hours": hours, "megabytes": disk}))
        return 0
    cells = [[readable.cell(v) for v in row.values()] for row in rows]
    show(f"{len(rows)} runs, {len(todo)} to do", list(rows[0]), cells)
    if not todo or any(row["hours"] is not None for row in todo):
        print(f"about {hours:.1f} h with {jobs} at a time and {readable.size(1e6 * disk)}", end="")
        free = _free_gb(store.path)
        print(f" ({free:.0f} GB are free)" if free is not None else "")
    unknown = sorted({f"{r['env']} {r['learner']}" for r in todo if r["hours"] is None})
    if unknown:
        print(
            f"without {', '.join(unknown)}: {args.store} has no finished run to judge them by "
            "(robots on a CPU are also judged by what `tom bench` last measured here)"
        )
    return 0


def longest(store: Store, planned: Sequence[Trial]) -> float | None:
    """The hours of the longest run from its start; None if a run cannot be projected."""
    runs = store.runs()
    expected = [_cost(trial, runs, None) for trial in planned]
    if any(one is None for one in expected):
        return None
    return max(one.hours for one in expected if one)


def _cost(trial: Trial, runs: Sequence[RunReader], run: RunReader | None) -> Cost | None:
    """The remaining cost of a training, from similar runs, else from this machine's `tom bench`."""
    # Imported here because it imports every part of a training.
    from tom.bench.last import bench_cost, last_bench

    at = None if run is None else checkpoint.newest(run.path / checkpoint.FOLDER)
    expected = cost(trial, runs, at or 0)
    if expected is not None:
        return expected
    ms = last_bench()
    return None if ms is None else bench_cost(trial, ms, at or 0)


def _finished(trial: Trial, run: RunReader | None) -> bool:
    return run is not None and is_done(trial.config, run)


def _row(trial: Trial, run: RunReader | None, expected: Cost | None) -> dict[str, Any]:
    return {
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


def _free_gb(store: Path) -> float | None:
    return shutil.disk_usage(store).free / 1e9 if store.is_dir() else None
