"""`tom weigh`: each learner's weights for recorded data, given a policy of interest."""

import argparse
import sys
from pathlib import Path
from time import perf_counter
from typing import Any

import torch

from tom import readable
from tom.analysis.weighing import POLICIES, Weighed, plan_weighing, setting_groups, settings_type
from tom.cli.output import ProgressReport, print_result, show
from tom.cli.parser import (
    add_config_options,
    add_json,
    add_store,
    leaf_fields,
    overrides,
)
from tom.data.card import sentence
from tom.data.datasets import FORMATS
from tom.envs import ANY, ENVS
from tom.learners import LEARNERS, WEIGHED_FIRST
from tom.machine.matmul import choose_matmul
from tom.readable import whole
from tom.record import Store
from tom.record.versions import command
from tom.reports import weighing_files

COLUMNS = (
    *("random_mean", "last_two", "spearman", "first_rise", "ess"),
    *("footprint", "footprint_se", "footprint_noise"),
)
FOOTPRINT = (
    "footprint: distance to fresh episodes of the policy (1: as without weights, 0: its own); "
    "se: its standard error over those episodes (-: fewer than five); noise: the distance of two "
    "halves of them"
)
COLLECTED_BY = (
    "policies that collected DATA, one for each policy_version above 0 in order, or one for all; "
    "for learners that need them if DATA lacks the columns behaviour_mean and behaviour_log_std"
)


def add_parser(subparsers, arguments: list[str]) -> None:
    parser = subparsers.add_parser(
        "weigh",
        description="Weigh recorded data, oldest first, as each learner would if POLICY were the "
        "policy of interest. Writes weights.parquet, profile.csv, profile.png, profile.svg and "
        "report.json.",
    )
    parser.add_argument("data", help=f"a run or weighing (id or folder), {FORMATS}")
    parser.add_argument("--policy", required=True, help=POLICIES)
    parser.add_argument(
        "--learner", nargs="+", default=list(WEIGHED_FIRST), metavar="LEARNER",
        help=", ".join(LEARNERS) + " [tom pmac mle]",
    )  # fmt: skip
    parser.add_argument("--env", help=f"the task of a dataset: {', '.join(ENVS)}, {ANY}")
    parser.add_argument(
        "--step", type=whole(1), metavar="N",
        help="take a run's buffer and policy at the model fit of env step N [at the end]",
    )  # fmt: skip
    parser.add_argument(
        "--collected-by", nargs="+", default=[], metavar="POLICY", help=COLLECTED_BY
    )
    parser.add_argument("--seeds", nargs="+", type=whole(0), default=[0, 1, 2], metavar="N")
    parser.add_argument(
        "--bins", type=whole(1, 10_000), default=100, metavar="N", help="bins of a profile [100]"
    )
    parser.add_argument(
        "--footprint", type=whole(1), default=1000, metavar="N",
        help="number of the policy's real transitions that TOM compares with [1000]",
    )  # fmt: skip
    parser.add_argument(
        "--preset",
        help="exact (of TOM), or a training's preset: paper, mended, released; own: the run's "
        "settings [own with --step, else exact]",
    )
    parser.add_argument("--out", type=Path, help="new folder [STORE/weighings/DATA-by-POLICY-TIME]")
    add_store(parser)
    add_json(parser, "print the report as JSON")
    settings = settings_type()
    wanted = ("threads", "matmul", *(f"{group}." for group in setting_groups()))
    left_out = {path for path, _ in leaf_fields(settings) if not path.startswith(wanted)}
    add_config_options(parser, settings, leave_out=left_out)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    store = Store(args.store)
    plan = plan_weighing(
        args.data, args.policy, store, env=args.env, step=args.step, preset=args.preset,
        collected_by=args.collected_by, settings=overrides(args), learners=args.learner,
        seeds=args.seeds, footprint=args.footprint,
    )  # fmt: skip
    data, by = plan.data.name, Path(args.policy).name.replace(":", ".")
    at = "" if args.step is None else f"-at-{args.step}"
    name = f"{data}-by-{by if by != data else 'its-own'}{at}"
    weighing_files.check_free(args.out or store.new_weighing(name))
    torch.set_num_threads(plan.config.threads)
    choose_matmul(plan.config.matmul)
    told = [text for _, text in plan.data.card.notices()]
    for notice in told:  # before work that may be in vain
        print(notice, file=sys.stderr)
    started, weighed = perf_counter(), list[Weighed]()
    steps = 2 * plan.footprint * len(plan.seeds)  # `tom.analysis.weighing.weigh`
    with ProgressReport(f"the policy in {plan.known.name}", steps, sys.stderr) as bar:
        for one in plan.carry_out(bar.step):
            weighed.append(one)
            bar.print(f"{plan.data.name}: {one.learner} seed {one.seed}")
    hours = (perf_counter() - started) / 3600
    report = weighing_files.report(plan, weighed, args.policy, args.step, command(), hours)
    out = args.out or store.new_weighing(name)
    weighing_files.write(out, plan.data, weighed, args.bins, report)
    for notice in weighing_files.notices(report)[len(told) :]:
        print(notice, file=sys.stderr)
    return print_result(args, {**report, "out": str(out)}, lambda: _print(report, out))


def _print(report: dict[str, Any], out: Path) -> None:
    rows = [
        [row["learner"], str(row["seed"]), *(readable.short(row[c]) for c in COLUMNS)]
        for row in report["results"]
    ]
    at = "" if report["step"] is None else f" at step {report['step']}"
    title = f"{report['data']}, weighed by {report['policy']}{at}"
    print(sentence(report["card"]))
    show(title, ("learner", "seed", *(c.replace("_", " ") for c in COLUMNS)), rows)
    print(FOOTPRINT)
    print(out)
