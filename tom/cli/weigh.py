"""`tom weigh`: what each learner makes of recorded data, given a policy of interest."""

import argparse
import json
import shlex
import sys
from datetime import datetime
from pathlib import Path
from time import perf_counter
from typing import Any

import torch
from pydantic import ValidationError

from tom.analysis.ordered_data import OrderedData, after_random, find_run, load_data
from tom.analysis.weighing import RANDOM, Weighed, load_policy, policy_env, weigh
from tom.cli.parser import add_config_options, folder, leaf_fields, one_line, overrides
from tom.cli.tables import show
from tom.config import RunConfig, TomConfig
from tom.envs import ENVS, task
from tom.errors import UserError, unknown
from tom.learners import LEARNERS
from tom.machine.matmul import choose_matmul
from tom.record import Store, layout
from tom.record.files import plain
from tom.record.versions import git_commit, versions
from tom.reports import weighing_files
from tom.training.resume import recorded_config

OWN = "own"
PRESETS = ("exact", "paper", OWN)
COLUMNS = ("footprint", "footprint_se", "footprint_noise")
FOOTPRINT = (
    "footprint: distance to fresh episodes of the policy, 1 without weights, 0 for its own; "
    "se: its standard error; noise: the distance of two halves of those episodes"
)
SETTINGS = ("tom.", "pmac.", "vagram.", "threads", "matmul")


def add_parser(subparsers, arguments: list[str]) -> None:
    parser = subparsers.add_parser(
        "weigh",
        help="weigh recorded data by a policy",
        description="Weigh recorded data, oldest first, as each learner would if POLICY were the "
        "policy of interest. Writes weights.parquet, profile.csv, profile.png, profile.svg and "
        "report.json.",
    )
    parser.add_argument("data", help="a run (id or folder), a D4RL file or a Minari folder")
    parser.add_argument(
        "--policy", required=True, help=f"a run (id or folder), its policy.npz, or {RANDOM}"
    )
    parser.add_argument(
        "--learner", nargs="+", default=["tom", "pmac", "mle"], metavar="LEARNER",
        help=", ".join(LEARNERS) + " [tom pmac mle]",
    )  # fmt: skip
    parser.add_argument("--env", help="the task of a dataset: " + ", ".join(ENVS))
    parser.add_argument(
        "--step", type=count, metavar="N",
        help="of a run: its buffer and its policy at the model fit of env step N [at the end]",
    )  # fmt: skip
    parser.add_argument("--random", help="random data put first, as much as DATA has")
    parser.add_argument("--seeds", nargs="+", type=whole, default=[0, 1, 2], metavar="N")
    parser.add_argument("--bins", type=count, default=100, metavar="N", help="of a profile [100]")
    parser.add_argument(
        "--footprint", type=count, default=1000, metavar="N",
        help="real transitions of the policy that TOM compares with [1000]",
    )  # fmt: skip
    parser.add_argument(
        "--preset",
        help="TOM's: exact or paper; own: the run's settings [own with --step, else exact]",
    )
    parser.add_argument("--out", type=Path, help="new folder [STORE/weighings/DATA-by-POLICY-TIME]")
    parser.add_argument("--store", type=folder, default=Path("runs"), help="run store (runs/)")
    parser.add_argument("--json", action="store_true", help="print the report as JSON")
    paths = {path for path, _ in leaf_fields(RunConfig)}
    left_out = {path for path in paths if not path.startswith(SETTINGS)}
    add_config_options(parser, RunConfig, leave_out=left_out)
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    store = Store(args.store)
    data, env = _data(args, store)
    known = task(env)
    args.preset = args.preset or ("exact" if args.step is None else OWN)
    config = _config(args, store, env)
    policy = load_policy(args.policy, store, known, args.step)
    for name in args.learner:
        if name not in LEARNERS:
            raise unknown("learner", name, LEARNERS)
    out = args.out or _default_out(store, data, args)
    weighing_files.check_free(out)
    torch.set_num_threads(config.threads)
    choose_matmul(config.matmul)
    begun, found = perf_counter(), list[Weighed]()
    learners, seeds = list(dict.fromkeys(args.learner)), list(dict.fromkeys(args.seeds))
    for one in weigh(data, policy, known, config, learners, seeds, args.footprint):
        found.append(one)
        print(f"{data.name}: {one.learner} seed {one.seed}", file=sys.stderr, flush=True)
    report = {
        "policy": args.policy,
        "step": args.step,
        "preset": args.preset,
        "footprint": args.footprint,
        "config": config.model_dump(include={"tom", "pmac", "vagram"}),
        **weighing_files.summary(data, found),
        "made": {
            "command": shlex.join(["tom", *sys.argv[1:]]),
            "git_commit": git_commit(),
            "versions": versions(),
            "hours": (perf_counter() - begun) / 3600,
        },
    }
    weighing_files.write(out, data, found, args.bins, report)
    _print(report, out, args.json)
    return 0


def _data(args: argparse.Namespace, store: Store) -> tuple[OrderedData, str]:
    env = args.env or policy_env(args.policy, store)
    data = load_data(args.data, store, env, args.step)
    if data.env != (env or data.env):
        raise UserError(f"{data.name} is of {data.env}, not of {env}: name a policy of {data.env}")
    if args.random:
        data = after_random(load_data(args.random, store, data.env), data)
    assert data.env is not None
    return data, data.env


def _config(args: argparse.Namespace, store: Store, env: str) -> RunConfig:
    if args.preset not in PRESETS:
        raise unknown("preset", args.preset, PRESETS)
    try:
        if args.preset == OWN:
            config = _own_settings(args.data, store)
        else:
            config = RunConfig(env=env, learner="tom", tom=TomConfig.preset(args.preset))
        return config.but(**overrides(args))
    except ValidationError as error:
        raise one_line(error) from None


def _own_settings(name: str, store: Store) -> RunConfig:
    run = find_run(name, store)
    if run is None:
        raise UserError(f"{name} is no run, so it has no settings: --preset exact or paper")
    own = recorded_config(run, "name --preset exact or paper")
    return RunConfig(env=own.env, learner="tom", tom=own.tom, pmac=own.pmac, vagram=own.vagram)


def _default_out(store: Store, data: OrderedData, args: argparse.Namespace) -> Path:
    by, at = _short_name(args.policy), "" if args.step is None else f"-at-{args.step}"
    name = f"{data.name}-by-{by}" if by != data.name else f"{data.name}-by-its-own"
    return store.path / layout.WEIGHINGS / f"{name}{at}-{datetime.now():%y%m%d-%H%M%S}"


def _short_name(policy: str) -> str:
    """What a weighing's folder calls a policy: its run's name, an earlier one's step too."""
    path = Path(policy)
    if path.suffix != ".npz":
        return path.name
    folder = path.absolute().parent
    return f"{folder.parent.name}-{path.stem}" if folder.name == layout.POLICIES else folder.name


def _print(report: dict[str, Any], out: Path, as_json: bool) -> None:
    if as_json:
        print(json.dumps(plain({**report, "out": str(out)}), allow_nan=False))
        return
    columns = ("random_mean", "last_two", "spearman", "first_rise", "ess", *COLUMNS)
    rows = [
        [row["learner"], str(row["seed"]), *(_number(row[c]) for c in columns)]
        for row in report["results"]
    ]
    at = "" if report["step"] is None else f" at step {report['step']}"
    title = f"{report['data']}, weighed by {report['policy']}{at}"
    show(title, ("learner", "seed", *(c.replace("_", " ") for c in columns)), rows)
    print(FOOTPRINT)
    print(out)


def _number(value: float | None) -> str:
    return "-" if value is None else f"{value:.3g}"


def whole(text: str) -> int:
    """A number from 0 on, for an option."""
    value = int(text)
    if value < 0:
        raise argparse.ArgumentTypeError(f"{text}: must be at least 0")
    return value


def count(text: str) -> int:
    """A number from 1 on, for an option."""
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"{text}: must be at least 1")
    return value
