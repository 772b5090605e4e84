"""`tom weigh`: each learner's weights for recorded data, given a policy of interest."""

import argparse
import json
import shlex
import sys
from pathlib import Path
from time import perf_counter
from typing import Any

import torch
from pydantic import ValidationError

from tom import readable
from tom.analysis.ordered_data import OrderedData
from tom.analysis.weighing import POLICIES, Weighed, plan_weighing, setting_groups, settings_type
from tom.cli.parser import add_config_options, folder, leaf_fields, one_line, overrides, seed_number
from tom.cli.progress import CountReport
from tom.cli.tables import show
from tom.data.datasets import FORMATS
from tom.envs import ANY, ENVS
from tom.learners import LEARNERS, WEIGHED_FIRST
from tom.machine.matmul import choose_matmul
from tom.record import Store, layout
from tom.record.files import plain
from tom.reports import weighing_files

MOST_BINS = 10_000
COLUMNS = ("footprint", "footprint_se", "footprint_noise")
FOOTPRINT = (
    "footprint: distance to fresh episodes of the policy, 1 without weights, 0 for its own; "
    "se: its standard error over those episodes (-: fewer than five); noise: the distance of two "
    "halves of them"
)
SETTINGS = ("tom.", "pmac.", "vagram.", "threads", "matmul")


def add_parser(subparsers, arguments: list[str]) -> None:
    parser = subparsers.add_parser(
        "weigh",
        description="Weigh recorded data, oldest first, as each learner would if POLICY were the "
        "policy of interest. Writes weights.parquet, profile.csv, profile.png, profile.svg and "
        "report.json.",
    )
    parser.add_argument("data", help=f"a run (id or folder), {FORMATS}")
    parser.add_argument("--policy", required=True, help=POLICIES)
    parser.add_argument(
        "--learner", nargs="+", default=list(WEIGHED_FIRST), metavar="LEARNER",
        help=", ".join(LEARNERS) + " [tom pmac mle]",
    )  # fmt: skip
    parser.add_argument("--env", help=f"the task of a dataset: {', '.join(ENVS)}, {ANY}")
    parser.add_argument(
        "--step", type=count, metavar="N",
        help="of a run: its buffer and its policy at the model fit of env step N [at the end]",
    )  # fmt: skip
    parser.add_argument("--random", help="random data put first, as much as DATA has")
    parser.add_argument("--seeds", nargs="+", type=seed_number, default=[0, 1, 2], metavar="N")
    parser.add_argument("--bins", type=bins, default=100, metavar="N", help="of a profile [100]")
    parser.add_argument(
        "--footprint", type=count, default=1000, metavar="N",
        help="real transitions of the policy that TOM compares with [1000]",
    )  # fmt: skip
    parser.add_argument(
        "--preset",
        help="exact (of TOM), or a training's: paper, mended, released; own: the run's settings "
        "[own with --step, else exact]",
    )
    parser.add_argument("--out", type=Path, help="new folder [STORE/weighings/DATA-by-POLICY-TIME]")
    parser.add_argument("--store", type=folder, default=Path("runs"), help="run store (runs/)")
    parser.add_argument("--json", action="store_true", help="print the report as JSON")
    settings = settings_type()
    wanted = (*SETTINGS, *(f"{group}." for group in setting_groups()))
    left_out = {path for path, _ in leaf_fields(settings) if not path.startswith(wanted)}
    add_config_options(parser, settings, leave_out=left_out)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    store = Store(args.store)
    try:
        plan = plan_weighing(
            args.data, args.policy, store, env=args.env, step=args.step, random=args.random,
            preset=args.preset, settings=overrides(args), learners=args.learner, seeds=args.seeds,
            footprint=args.footprint,
        )  # fmt: skip
    except ValidationError as error:
        raise one_line(error) from None
    name = _name(plan.data, args)
    weighing_files.check_free(args.out or store.new_weighing(name))
    torch.set_num_threads(plan.config.threads)
    choose_matmul(plan.config.matmul)
    begun, weighed = perf_counter(), list[Weighed]()
    with CountReport(f"the policy in {plan.known.name}", plan.steps, sys.stderr) as bar:
        for one in plan.carry_out(bar.step):
            weighed.append(one)
            bar.say(f"{plan.data.name}: {one.learner} seed {one.seed}")
    command = shlex.join(["tom", *sys.argv[1:]])
    hours = (perf_counter() - begun) / 3600
    report = weighing_files.report(plan, weighed, args.policy, args.step, command, hours)
    with weighing_files.place(args.out, store, name) as out:
        weighing_files.write(out, plan.data, weighed, args.bins, report)
    for notice in weighing_files.notices(report):
        print(notice, file=sys.stderr)
    _print(report, out, args.json)
    return 0


def _name(data: OrderedData, args: argparse.Namespace) -> str:
    """Of the weighing's folder, without the date."""
    by, at = _short_name(args.policy), "" if args.step is None else f"-at-{args.step}"
    name = f"{data.name}-by-{by}" if by != data.name else f"{data.name}-by-its-own"
    return f"{name}{at}"


def _short_name(policy: str) -> str:
    """The policy's name in a weighing's folder: its run's name, with the step if one was chosen."""
    path = Path(policy)
    if path.suffix != ".npz":
        return path.name.replace(":", ".")
    folder = path.absolute().parent
    return f"{folder.parent.name}-{path.stem}" if folder.name == layout.POLICIES else folder.name


def _print(report: dict[str, Any], out: Path, as_json: bool) -> None:
    if as_json:
        print(json.dumps(plain({**report, "out": str(out)}), allow_nan=False))
        return
    columns = ("random_mean", "last_two", "spearman", "first_rise", "ess", *COLUMNS)
    rows = [
        [row["learner"], str(row["seed"]), *(readable.short(row[c]) for c in columns)]
        for row in report["results"]
    ]
    at = "" if report["step"] is None else f" at step {report['step']}"
    title = f"{report['data']}, weighed by {report['policy']}{at}"
    show(title, ("learner", "seed", *(c.replace("_", " ") for c in columns)), rows)
    print(FOOTPRINT)
    print(out)


def count(text: str) -> int:
    """An integer of at least 1, for argparse."""
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{text}: must be at least 1")
    return value


def bins(text: str) -> int:
    """A number of bins that a run may have as well, for argparse."""
    value = count(text)
    if value > MOST_BINS:
        raise argparse.ArgumentTypeError(f"{text}: must be at most {MOST_BINS}")
    return value
