"""`tom bench`: measurements on this machine, as tables.

Each function below measures one thing and returns tables by title.
"""

import argparse
import io
from contextlib import redirect_stdout
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

from tom.cli import exec_module
from tom.cli.output import print_result, show_rows
from tom.cli.parser import add_json
from tom.cli.runs import list_runs
from tom.machine.matmul import choose_matmul
from tom.machine.memory import keep_freed_memory
from tom.readable import whole

NOT_MEASURED = {
    "GPU": "nothing here runs on one; see docs/speed.md",
    "projected hours": "they leave out evaluation and recording, and count every round of a fit",
}
Tables = dict[str, list[dict[str, Any]]]


def add_parser(subparsers, arguments: list[str]) -> None:
    parser = subparsers.add_parser("bench", description="Measure parts on this machine.")
    parser.add_argument(
        "what",
        nargs="?",
        default="parts",
        choices=(*MEASUREMENTS, "studio"),
        help="parts: the cost of each part of a training, and of whole trainings projected from "
        "it [the default]; step: a whole env step of the paper's Hopper; memory: a full Humanoid "
        "buffer; record: the cost of recording, and of listing 1000 runs; studio: how long its "
        "pages take with a store of 200 runs (--map: the buffer's map in a browser)",
    )
    parser.add_argument(
        "--repeats", type=whole(1), default=9, help="interleaved repeats [9] (parts)"
    )
    add_json(parser)
    parser.add_argument("--runs", type=int, help="runs in the store [200] (studio)")
    parser.add_argument(
        "--map", action="store_true", help="the buffer's map in a browser instead (studio)"
    )
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    if args.what == "studio":
        runs = [] if args.runs is None else ["--runs", str(args.runs)]
        more = [*(["--json"] * args.json), *(["--map"] * args.map)]
        exec_module("app.servers.bench", [*runs, *more])
    tables = MEASUREMENTS[args.what](args)
    return print_result(args, tables, lambda: [show_rows(*table) for table in tables.items()])


def _parts(args: argparse.Namespace) -> Tables:
    from tom.bench import parts, projection, timing

    torch.set_num_threads(1)
    keep_freed_memory()
    backend = choose_matmul().chosen
    timings, gflops = timing.measure([*parts.parts()], args.repeats, backend)
    ms = {timed.part: timed.ms for timed in timings}
    rows, beside_ms = [], projection.beside_ms(ms)
    for timed in timings:
        wanted, met = timing.target(timed, beside_ms) or (None, None)
        rows.append({**asdict(timed), "target": wanted, "met": met})
    return {
        f"CPU ms, one thread; {gflops:.0f} GFLOP/s in 256^3 products ({backend})": rows,
        "TOM on one core, hours at most": projection.hours(ms),
        "not measured": [{"what": what, "why": why} for what, why in NOT_MEASURED.items()],
    }


def _step(_: argparse.Namespace) -> Tables:
    from tom.bench import timing, training

    ms, gflop = training.step_ms()
    gflops = timing.measure([], 5, choose_matmul().chosen)[1]
    floor = gflop / gflops * 1000
    row = {"ms": ms, "floor_ms": floor, "times_floor": ms / floor, "gflops": gflops}
    row |= {"authors_ms": training.AUTHORS_MS, "met": ms <= training.AUTHORS_MS / 2}
    return {"an env step of the paper's Hopper, CPU ms (the authors' on their machine)": [row]}


def _memory(_: argparse.Namespace) -> Tables:
    from tom.bench.training import buffer_memory

    filled, fitted = buffer_memory()
    row = {"filled_gb": filled, "after_fit_gb": fitted, "target": "< 2.5 GB", "met": fitted < 2.5}
    return {"peak memory with 1e6 Humanoid transitions": [row]}


def _record(_: argparse.Namespace) -> Tables:
    from tom.bench import training

    def list_all(store: Path) -> None:
        everything = dict.fromkeys(("task", "learner", "tag", "state"))
        with redirect_stdout(io.StringIO()):
            list_runs(argparse.Namespace(store=store, json=True, **everything))

    torch.set_num_threads(1)
    choose_matmul()
    train_s = training.step_ms(training.CYCLE)[0] * training.CYCLE / 1e3
    checkpoints = [
        training.checkpoint_cost(*of) for of in (("hopper", train_s), ("humanoid", None))
    ]
    title = f"recording, for each 250 env steps of Hopper ({train_s:.1f} s of CPU time)"
    return {
        title: training.recording_costs(train_s),
        "checkpoints, one every 2000 steps": checkpoints,
        "tom runs list, once tom is loaded": [training.listing_cost(list_all)],
        "a loop of one's own, microseconds": training.loop_costs(),
    }


MEASUREMENTS = {
    "parts": _parts,
    "step": _step,
    "memory": _memory,
    "record": _record,
}
