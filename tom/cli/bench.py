"""`tom bench`: measurements on this machine, as tables."""

import argparse
import io
import json
import signal
import tempfile
from contextlib import redirect_stdout
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch

from tom import readable
from tom.cli import studio
from tom.cli.parser import folder, seed_number
from tom.cli.runs import list_runs
from tom.cli.signals import on_stopping
from tom.cli.tables import show
from tom.errors import UserError, unknown
from tom.learners import LEARNERS
from tom.machine.matmul import choose_matmul
from tom.machine.memory import keep_freed_memory
from tom.record import RunReader, Store
from tom.sweep import train_all

LEARN_ENV = "inverted-pendulum"
LEARN_STEPS = 6000
LEARN_RETURN = 950.0


def add_parser(subparsers, arguments: list[str]) -> None:
    parser = subparsers.add_parser("bench", description="Measure parts on this machine.")
    parser.add_argument(
        "what",
        nargs="?",
        default="parts",
        choices=("parts", "step", "memory", "learn", "record", "studio"),
        help="parts: what each part of a training costs, and whole trainings from that [the "
        "default]; step: a whole env step of the paper's Hopper; "
        "memory: a full Humanoid buffer; record: the cost of recording, and of "
        "listing 1000 runs; learn: does inverted pendulum reach 950 within 6000 steps; studio: how "
        "long its pages take over a store of 200 runs",
    )
    parser.add_argument("--repeats", type=int, default=9, help="interleaved repeats (parts)")
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.add_argument(
        "--into",
        type=Path,
        metavar="FILE",
        help="put the tables, as Markdown, between the lines <!-- bench --> and <!-- /bench --> of "
        "this file (parts)",
    )
    parser.add_argument("--learner", nargs="+", default=["mle", "tom"], help="(learn)")
    parser.add_argument("--seeds", nargs="+", type=seed_number, default=[0, 1, 2], help="(learn)")
    parser.add_argument(
        "--steps", type=int, default=LEARN_STEPS, help=f"env steps in all [{LEARN_STEPS}] (learn)"
    )
    parser.add_argument("--store", type=folder, help="keep the runs here (learn)")
    parser.add_argument("--runs", type=int, help="runs in the store [200] (studio)")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    if args.into is not None and args.what != "parts":
        raise UserError("--into is of the tables of `tom bench parts`: leave it out")
    if args.what == "learn":
        _check_learn(args)
        with on_stopping(signal.default_int_handler):  # its trainings must end with it
            rows = learn(args.learner, args.seeds, args.steps, args.store)
        if not rows:
            raise UserError("none of the trainings began: see above why")
        _print(f"{LEARN_ENV}: {LEARN_RETURN:.0f} within {args.steps} steps", rows, args.json)
        reached = [row for row in rows if row["reached_at"] is not None]
        return 0 if len(reached) == len(args.learner) * len(args.seeds) else 1
    if args.what == "studio":
        studio.hand_over(studio_words(args), "app.servers.bench")
    if args.what == "parts":
        return _parts(args.repeats, args.json, args.into)
    return {"record": _record, "step": _step, "memory": _memory}[args.what](args.json)


NOT_MEASURED = (
    "GPU: nothing here runs on one; see docs/speed.md",
    "projected hours leave out evaluation and recording, and count every round of a fit",
)


def _parts(repeats: int, as_json: bool, into: Path | None) -> int:
    from tom.bench import last, parts, peers, projection, report, targets, timing

    if into is not None:
        report.require_place(into)

    torch.set_num_threads(1)
    keep_freed_memory()
    backend = choose_matmul().chosen
    measured = [*parts.parts(), *peers.peers()]
    timings, gflops = timing.measure(measured, max(repeats, 1), backend)
    ms = {timed.part: timed.ms for timed in timings}
    last.save(ms)
    rows, between_ms = [], projection.between_fits_ms(ms)
    for timed in timings:
        wanted, met = targets.target(timed, between_ms) or (None, None)
        rows.append({**asdict(timed), "target": wanted, "met": met})
    hours = projection.hours(ms)
    missing = [*NOT_MEASURED, *peers.missing()]
    result = {"gflops": gflops, "matmul": backend, "parts": rows, "hours": hours}
    result["not_measured"] = missing
    if into is not None:
        report.put(into, report.page(result))
    if as_json:
        print(json.dumps(result))
        return 0
    title = f"CPU ms, one thread; {gflops:.0f} GFLOP/s in 256^3 products ({backend})"
    _table(title, rows)
    _table("TOM on one core, hours at most", hours)
    print("not measured:", *missing, sep="\n  ")
    return 0


def _step(as_json: bool) -> int:
    from tom.bench import timing, training

    ms, gflop = training.step_ms()
    _, gflops = timing.measure([], 5, choose_matmul().chosen)
    floor = gflop / gflops * 1000
    row = {"ms": ms, "floor_ms": floor, "times_floor": ms / floor, "gflops": gflops}
    row |= {"authors_ms": training.AUTHORS_MS, "met": ms <= training.AUTHORS_MS / 2}
    _print(
        "an env step of the paper's Hopper, CPU ms (the authors' on their machine)", [row], as_json
    )
    return 0


def _memory(as_json: bool) -> int:
    from tom.bench.training import buffer_memory

    filled, fitted = buffer_memory()
    row = {"filled_gb": filled, "after_fit_gb": fitted, "target": "< 2.5 GB", "met": fitted < 2.5}
    _print("peak memory with 1e6 Humanoid transitions", [row], as_json)
    return 0


def _record(as_json: bool) -> int:
    from tom.bench import listing
    from tom.bench.checkpoints import checkpoint_costs
    from tom.bench.recording import cost
    from tom.bench.training import cycle_s

    torch.set_num_threads(1)
    choose_matmul()
    train_s = cycle_s()
    title = f"recording, for each 250 env steps of Hopper ({train_s:.1f} s of CPU time)"
    costs = [asdict(row) for row in cost(train_s)]
    checkpoints = [asdict(row) for row in checkpoint_costs(train_s)]
    listed = listing.measure(_list)
    lists = [{**asdict(listed), "met": listed.met}]
    if as_json:
        measured = {"recording": costs, "checkpoints": checkpoints, "listing": lists}
        print(json.dumps(measured))
        return 0
    _table(title, costs)
    _table("checkpoints, one every 2000 steps", checkpoints)
    _table("tom runs list, once tom is loaded", lists)
    return 0


def _list(store: Path) -> None:
    """`tom runs list --json` of `store`, with its output discarded."""
    everything = dict.fromkeys(("env", "learner", "tag", "state"))
    with redirect_stdout(io.StringIO()):
        list_runs(argparse.Namespace(store=store, json=True, **everything))


def _check_learn(args: argparse.Namespace) -> None:
    """Remove duplicate learners and seeds. Raises UserError for an impossible one."""
    args.learner, args.seeds = list(dict.fromkeys(args.learner)), list(dict.fromkeys(args.seeds))
    for learner in args.learner:
        if learner not in LEARNERS:
            raise unknown("learner", learner, LEARNERS)
    if args.steps < 1:
        raise UserError("--steps must be at least 1")


def learn(
    learners: list[str], seeds: list[int], steps: int, store: Path | None
) -> list[dict[str, Any]]:
    """Train inverted pendulum for each learner and seed; report when each first reached 950."""
    with tempfile.TemporaryDirectory() as scratch:
        path = store or Path(scratch)
        before = {run.run_id for run in Store(path).runs()}
        train_all(_learn_commands(learners, seeds, steps, path))
        rows = [_learn_row(r) for r in Store(path).runs() if r.run_id not in before]
    return sorted(rows, key=lambda row: (row["learner"], row["seed"]))


def _learn_commands(
    learners: list[str], seeds: list[int], steps: int, store: Path
) -> dict[str, tuple[str, ...]]:
    shared = ("--env", LEARN_ENV, "--store", str(store), "--no-rerun", "--steps", str(steps))
    return {
        f"{learner} {seed}": ("--learner", learner, "--seed", str(seed), *shared)
        for learner in learners
        for seed in seeds
    }


def _learn_row(run: RunReader) -> dict[str, Any]:
    table, status = run.metrics(), run.status
    step, value, wall = (
        table[name].to_numpy(float) if name in table else np.zeros(0)
        for name in ("env_step", "eval/return", "time/wall_s")
    )
    good = step[value >= LEARN_RETURN] if len(value) else step[:0]
    return {
        "learner": run.learner,
        "seed": run.seed,
        "state": status.state,
        "reached_at": int(good[0]) if len(good) else None,
        "best": status.best_return,
        "final": status.last_return,
        "wall_s": round(float(np.nanmax(wall, initial=0.0)), 1),
    }


def studio_words(args: argparse.Namespace) -> list[str]:
    """The arguments for the studio's own measurement."""
    runs = [] if args.runs is None else ["--runs", str(args.runs)]
    return runs + ["--json"] * args.json


def _print(title: str, rows: list[dict[str, Any]], as_json: bool) -> None:
    if as_json:
        print(json.dumps(rows))
    else:
        _table(title, rows)


def _table(title: str, rows: list[dict[str, Any]]) -> None:
    show(title, list(rows[0]), [[readable.cell(value) for value in row.values()] for row in rows])
