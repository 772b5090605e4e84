"""`tom brush`: refit the model with a region of the buffer counting more or less."""

import argparse
import sys
from pathlib import Path
from time import perf_counter

import numpy as np
import torch
from numpy.typing import NDArray

from tom.analysis import brush
from tom.analysis.brush import FACTORS, SMALL, BrushedFit
from tom.analysis.imagine import imagine, joint_positions
from tom.analysis.ordered_data import OrderedData, find_run, load_run
from tom.analysis.weighing import collect_footprint, load_policy
from tom.cli.output import print_result
from tom.cli.parser import add_json, add_store
from tom.data.unpack import DAMAGE
from tom.envs import scene, task
from tom.errors import UserError, reason
from tom.frames import Run
from tom.machine.matmul import choose_matmul
from tom.readable import whole
from tom.record import RunReader, Store, layout
from tom.record.decode import read_table
from tom.record.reader import at_or_before
from tom.record.versions import command, made_by
from tom.reports import weighing_files

FRESH = 2000
HORIZON = 20
"""steps after which a ghost restarts from the real state"""


def add_parser(subparsers, arguments: list[str]) -> None:
    parser = subparsers.add_parser(
        "brush",
        description="Multiply the weights of some transitions of a run's buffer, fit a new small "
        "model by them, and measure what it loses or gains on held-out episodes. Writes a "
        "weighing, with the errors in report.json and the ghosts of an episode in ghosts.npz.",
    )
    parser.add_argument("run_name", metavar="RUN", help="a run (id or folder)")
    parser.add_argument("--env", help="the run's task, if it is in a module of yours: MODULE:ID")
    parser.add_argument(
        "--rows", type=Path, required=True, help="a text file of row numbers, from 0"
    )
    parser.add_argument(
        "--step", type=whole(1), required=True, metavar="N", help="step of a kept model fit"
    )
    parser.add_argument(
        "--weighing", help="the weights are COLUMN of a weighing: FOLDER:COLUMN [the run's own]"
    )
    parser.add_argument(
        "--factors", nargs="+", type=float, default=list(FACTORS), metavar="X",
        help="factors for the region's weights [0 0.25 4]",
    )  # fmt: skip
    parser.add_argument("--seeds", nargs="+", type=whole(0), default=[0, 1, 2], metavar="N")
    parser.add_argument("--hidden", type=whole(1), default=SMALL.hidden, help="[%(default)s]")
    parser.add_argument("--layers", type=whole(1), default=SMALL.layers, help="[%(default)s]")
    parser.add_argument("--out", type=Path, help="new folder [STORE/weighings/RUN-brushed-TIME]")
    add_store(parser)
    add_json(parser, "print the report as JSON")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    for factor in args.factors:
        brush.check_factor(factor)
    config = SMALL.but(hidden=args.hidden, layers=args.layers)
    torch.set_num_threads(1)
    choose_matmul("default")
    store = Store(args.store)
    reader = find_run(args.run_name, store)
    if reader is None:
        raise UserError(f"no run '{args.run_name}' in {store.path}/: name one of `tom runs list`")
    data = load_run(reader, args.step)
    region = _region(args.rows, data, args.step)
    weights = _weights(args.weighing, reader, store, data, args.step)
    fresh = None
    if args.step in reader.policy_steps():
        known = task(reader.env)
        policy = load_policy(str(reader.path), store, known, args.step)
        episodes = collect_footprint(known, policy, FRESH, min(args.seeds), "fresh episodes")
        fresh = episodes.transitions.torch()
    work = data.transitions, torch.tensor(weights), torch.from_numpy(region), fresh
    name, seeds = f"{reader.run_id}-brushed", list(dict.fromkeys(args.seeds))
    weighing_files.check_free(args.out or store.new_weighing(name))
    started, models = perf_counter(), list[BrushedFit]()
    total = len(dict.fromkeys((brush.UNCHANGED, *args.factors))) * len(seeds)
    for one in brush.fit_brushed(*work, config, args.factors, seeds):
        models.append(one)
        text = f"model {len(models)} of {total}: region x {one.factor:g}, seed {one.seed}"
        print(text, file=sys.stderr, flush=True)
    report = {
        "data": data.name,
        "env": data.env,
        "policy": reader.run_id,
        "preset": "own",
        "rows": len(data),
        "ordered_from": data.ordered_from,
        "step": args.step,
        "end": data.end,
        weighing_files.BRUSH: {
            "of": args.weighing or "own",
            "fresh": 0 if fresh is None else len(fresh),
            "model": config.model_dump(include={"kind", "hidden", "layers", "rounds"}),
        },
        "made": {**made_by(command()), "hours": (perf_counter() - started) / 3600},
    }
    ghosts = _ghosts(reader, models, args.step)
    out = args.out or store.new_weighing(name)
    weighing_files.write_brush(out, region, models, report, ghosts)
    return print_result(args, {"out": str(out)}, [str(out)])


def _region(path: Path, data: OrderedData, step: int) -> NDArray[np.bool_]:
    """The rows listed in the file, by their numbers in the run's record, as a mask (N,)."""
    try:
        numbers = np.array(path.read_text().split(), np.int64)
    except (OSError, ValueError, OverflowError) as error:
        raise UserError(
            f"--rows {path}: {reason(error)}; write row numbers into it, one per line"
        ) from None
    first = data.end - len(data)
    if not len(numbers) or numbers.min() < first or numbers.max() >= data.end:
        raise UserError(
            f"--rows {path}: the buffer of run {data.name} at step {step} holds the rows "
            f"{first} to {data.end - 1}: name some of these"
        )
    region = np.zeros(len(data), bool)
    region[numbers - first] = True
    return region


def _weights(
    weighing: str | None, reader: RunReader, store: Store, data: OrderedData, step: int
) -> NDArray[np.float32]:
    """The weights (N,) of `data` in a column of a weighing, or those of the run at `step`."""
    if weighing is None:
        return Run(reader).weights(step)["weight"].to_numpy(np.float32)
    place, _, column = weighing.rpartition(":")
    path = Path(place) if "/" in place else store.beside(layout.WEIGHINGS) / place
    try:
        report = weighing_files.read_report(path)
        weights = read_table(path / weighing_files.WEIGHTS)[column].to_numpy(np.float32)
    except (KeyError, *DAMAGE) as error:
        raise UserError(
            f"--weighing {weighing}: no such weights ({error}): name FOLDER:COLUMN"
        ) from None
    if (report["data"], report["end"], len(weights)) != (data.name, data.end, len(data)):
        raise UserError(
            f"--weighing {weighing} weighs {len(weights)} rows of {report['data']} up to row "
            f"{report['end']}, not the {len(data)} of {data.name} at step {step}: weigh these"
        )
    return weights


def _ghosts(reader: RunReader, fitted: list[BrushedFit], step: int) -> dict[str, NDArray]:
    """Joint positions (H + 1, nq) of a recorded episode and of its prediction by each model.

    The models are the first seed's; the episode is from the last evaluation at or before `step`.
    Empty if no episode was recorded, or observations do not hold the joints.
    """
    known, evaluated = task(reader.env), reader.evaluation_steps()
    if not evaluated or known.root_dims is None:
        return {}
    episodes = reader.episodes(at_or_before(evaluated, step))
    longest = max(episodes, key=lambda e: e.length, default=None)
    if longest is None or longest.qpos is None or not longest.length:
        return {}
    models = {one.factor: one.model for one in fitted if one.seed == fitted[0].seed}
    dt = scene.model(reader.env).dt
    found = {"real": np.asarray(longest.qpos, np.float32), "dt": np.array(dt)}
    for factor, model in models.items():
        obs = imagine(model, longest, HORIZON).obs
        found[f"x{factor:g}"] = joint_positions(known, longest, obs, dt, HORIZON)
    return found
