"""`tom bench`: measurements on this machine, as tables.

Each function below measures one thing and returns its result for JSON and the tables that show it.
"""

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

from tom.cli import hand_over
from tom.cli.parser import add_json, folder, whole
from tom.cli.runs import list_runs
from tom.cli.tables import show_rows
from tom.errors import UserError, unknown
from tom.learners import LEARNERS
from tom.machine.matmul import choose_matmul
from tom.machine.memory import keep_freed_memory
from tom.machine.processes import on_stopping
from tom.record import RunReader, Store
from tom.sweep.engine import train_all

LEARN_ENV = "inverted-pendulum"
LEARN_STEPS = 6000
LEARN_RETURN = 950.0
NOT_MEASURED = (
    "GPU: nothing here runs on one; see docs/speed.md",
    "projected hours leave out evaluation and recording, and count every round of a fit",
)

Rows = list[dict[str, Any]]
Measured = tuple[object, dict[str, Rows]]
"""the content for JSON, and tables by title"""


def add_parser(subparsers, arguments: list[str]) -> None:
    parser = subparsers.add_parser("bench", description="Measure parts on this machine.")
    parser.add_argument(
        "what",
        nargs="?",
        default="parts",
        choices=(*MEASUREMENTS, "studio"),
        help="parts: what each part of a training costs, and whole trainings from that [the "
        "default]; step: a whole env step of the paper's Hopper; "
        "memory: a full Humanoid buffer; record: the cost of recording, and of "
        "listing 1000 runs; learn: does inverted pendulum reach 950 within 6000 steps; studio: how "
        "long its pages take over a store of 200 runs (--map: the buffer's map in a browser)",
    )
    parser.add_argument(
        "--repeats", type=whole(1), default=9, help="interleaved repeats [9] (parts)"
    )
    add_json(parser)
    parser.add_argument(
        "--into",
        type=Path,
        metavar="FILE",
        help="put the tables, as Markdown, between the lines <!-- bench --> and <!-- /bench --> of "
        "this file (parts)",
    )
    parser.add_argument("--learner", nargs="+", default=["mle", "tom"], help="(learn)")
    parser.add_argument("--seeds", nargs="+", type=whole(0), default=[0, 1, 2], help="(learn)")
    parser.add_argument(
        "--steps",
        type=whole(1),
        default=LEARN_STEPS,
        help=f"env steps in all [{LEARN_STEPS}] (learn)",
    )
    parser.add_argument("--store", type=folder, help="keep the runs here (learn)")
    parser.add_argument("--runs", type=int, help="runs in the store [200] (studio)")
    parser.add_argument(
        "--map", action="store_true", help="the buffer's map in a browser, instead (studio)"
    )
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    if args.into is not None and args.what != "parts":
        raise UserError("--into is of the tables of `tom bench parts`: leave it out")
    if args.what == "studio":
        runs = [] if args.runs is None else ["--runs", str(args.runs)]
        more = [*(["--json"] * args.json), *(["--map"] * args.map)]
        hand_over("app.servers.bench", [*runs, *more])
    content, tables = MEASUREMENTS[args.what](args)
    if args.json:
        print(json.dumps(content))
    else:
        for title, rows in tables.items():
            show_rows(title, rows)
        if isinstance(content, dict) and "not_measured" in content:
            print("not measured:", *content["not_measured"], sep="\n  ")
    if args.what != "learn":
        return 0
    reached = [row for table in tables.values() for row in table if row["reached_at"] is not None]
    return 0 if len(reached) == len(args.learner) * len(args.seeds) else 1


def _parts(args: argparse.Namespace) -> Measured:
    from tom.bench import parts, peers, projection, report, timing

    if args.into is not None:
        report.require_place(args.into)
    torch.set_num_threads(1)
    keep_freed_memory()
    backend = choose_matmul().chosen
    measured = [*parts.parts(), *peers.peers()]
    timings, gflops = timing.measure(measured, args.repeats, backend)
    ms = {timed.part: timed.ms for timed in timings}
    projection.save_bench(ms)
    rows, beside_ms = [], projection.beside_ms(ms)
    for timed in timings:
        wanted, met = timing.target(timed, beside_ms) or (None, None)
        rows.append({**asdict(timed), "target": wanted, "met": met})
    hours = projection.hours(ms)
    content = {"gflops": gflops, "matmul": backend, "parts": rows, "hours": hours}
    content["not_measured"] = [*NOT_MEASURED, *peers.missing()]
    if args.into is not None:
        report.put(args.into, report.page(content))
    title = f"CPU ms, one thread; {gflops:.0f} GFLOP/s in 256^3 products ({backend})"
    return content, {title: rows, "TOM on one core, hours at most": hours}


def _step(_: argparse.Namespace) -> Measured:
    from tom.bench import timing, training

    ms, gflop = training.step_ms()
    gflops = timing.measure([], 5, choose_matmul().chosen)[1]
    floor = gflop / gflops * 1000
    row = {"ms": ms, "floor_ms": floor, "times_floor": ms / floor, "gflops": gflops}
    row |= {"authors_ms": training.AUTHORS_MS, "met": ms <= training.AUTHORS_MS / 2}
    title = "an env step of the paper's Hopper, CPU ms (the authors' on their machine)"
    return [row], {title: [row]}


def _memory(_: argparse.Namespace) -> Measured:
    from tom.bench.training import buffer_memory

    filled, fitted = buffer_memory()
    row = {"filled_gb": filled, "after_fit_gb": fitted, "target": "< 2.5 GB", "met": fitted < 2.5}
    return [row], {"peak memory with 1e6 Humanoid transitions": [row]}


def _record(_: argparse.Namespace) -> Measured:
    from tom.bench.recording import checkpoint_costs, listing_cost, loop_costs, recording_costs
    from tom.bench.training import cycle_s

    def list_all(store: Path) -> None:
        everything = dict.fromkeys(("env", "learner", "tag", "state"))
        with redirect_stdout(io.StringIO()):
            list_runs(argparse.Namespace(store=store, json=True, **everything))

    torch.set_num_threads(1)
    choose_matmul()
    train_s = cycle_s()
    content = {
        "recording": recording_costs(train_s),
        "checkpoints": checkpoint_costs(train_s),
        "listing": [listing_cost(list_all)],
        "loop": loop_costs(),
    }
    titles = (
        f"recording, for each 250 env steps of Hopper ({train_s:.1f} s of CPU time)",
        "checkpoints, one every 2000 steps",
        "tom runs list, once tom is loaded",
        "a loop of one's own, microseconds",
    )
    return content, dict(zip(titles, content.values(), strict=True))


def _learn(args: argparse.Namespace) -> Measured:
    """Train inverted pendulum for each learner and seed; report when each first reached 950."""
    args.learner, args.seeds = list(dict.fromkeys(args.learner)), list(dict.fromkeys(args.seeds))
    for learner in args.learner:
        if learner not in LEARNERS:
            raise unknown("learner", learner, LEARNERS)
    with tempfile.TemporaryDirectory() as scratch:
        store = Store(args.store or Path(scratch))
        before = {run.run_id for run in store.runs()}
        shared = (
            "--env",
            LEARN_ENV,
            "--no-rerun",
            f"--steps={args.steps}",
            f"--store={store.path}",
        )
        commands = {
            f"{name} {seed}": ("--learner", name, f"--seed={seed}", *shared)
            for name in args.learner
            for seed in args.seeds
        }
        with on_stopping(signal.default_int_handler):  # its trainings must end with it
            train_all(commands)
        rows = [learnt(run) for run in store.runs() if run.run_id not in before]
    if not rows:
        raise UserError("none of the trainings began: see above why")
    rows.sort(key=lambda row: (row["learner"], row["seed"]))
    return rows, {f"{LEARN_ENV}: {LEARN_RETURN:.0f} within {args.steps} steps": rows}


def learnt(run: RunReader) -> dict[str, Any]:
    """When a run first reached LEARN_RETURN, and its returns."""
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


MEASUREMENTS = {
    "parts": _parts,
    "step": _step,
    "memory": _memory,
    "learn": _learn,
    "record": _record,
}
