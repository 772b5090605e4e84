"""`tom reproduce progression`: the weight progression on an ordered buffer."""

import argparse
import json
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import torch

from tom.cli.study import out_folder, sac_recordings, say, stoppable
from tom.cli.tables import show
from tom.envs import task
from tom.errors import UserError, unknown
from tom.matmul import choose_matmul
from tom.record import Store
from tom.record.files import plain
from tom.reports import progression_files
from tom.reports.origin import seeds as in_short
from tom.reports.study import write_study
from tom.studies.progression import SAC_SEEDS, Case, Check, cases, checks

PRESETS = ("exact", "paper")
CLAIM = (
    "On a buffer whose first half is random and whose second half is SAC's training in order, "
    "TOM's weights for the trained policy are low on the random half and rise towards the end; "
    "they start to rise earlier than recency would have it, sometimes non-monotonically (5.2)."
)
CAPTION = "Mean weight along the ordered buffer, single seeds faint"


def add_parser(subparsers, arguments: list[str]) -> None:
    parser = subparsers.add_parser(
        "progression",
        help="weights along an ordered replay buffer",
        description="Record SAC where the store has no such recording, weigh every recording for "
        "its own policy, for the random policy and with its rows shuffled, and hold the profiles "
        "against the acceptance. Median over TOM's seeds; the first preset is judged.",
    )
    parser.add_argument("--env", nargs="+", default=list(SAC_SEEDS), metavar="ENV")
    parser.add_argument("--steps", type=int, default=50_000, help="steps of SAC [50000]")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2], help="TOM's [0 1 2]")
    parser.add_argument("--sac-seeds", nargs="+", type=int, help="of recordings [as accepted]")
    parser.add_argument("--preset", nargs="+", default=list(PRESETS), help="TOM's [exact paper]")
    parser.add_argument("--store", type=Path, default=Path("runs"), help="run store (runs/)")
    parser.add_argument("--out", type=Path, default=Path("reports/progression"))
    parser.add_argument("--json", action="store_true", help="print the checks as JSON")
    parser.set_defaults(run=run)


@stoppable
def run(args: argparse.Namespace) -> int:
    for preset in args.preset:
        if preset not in PRESETS:
            raise unknown("preset", preset, PRESETS)
    if args.steps < 1000 or min(args.seeds) < 0:
        raise UserError("--steps must be at least 1000 and --seeds at least 0")
    envs = [task(env).name for env in args.env]
    out_folder(args.out)
    runs = sac_recordings(Store(args.store), envs, args.sac_seeds, args.steps)
    torch.set_num_threads(1)
    choose_matmul()
    done: list[Case] = []
    for reader in runs:
        for case in cases(reader, args.preset, args.seeds):
            progression_files.keep_weights(args.out, case)
            done.append(case)
            say(f"{case.recording}: TOM {case.preset}, {case.condition}")
    found = checks(done)
    progression_files.write(args.out, done, found, args.preset[0])
    _report(found, args)
    _print(found, args)
    return 0 if all(c.met is not False for c in found if c.preset == args.preset[0]) else 1


def _report(found: Sequence[Check], args: argparse.Namespace) -> None:
    rows = [
        {
            "name": f"{c.recording}, {c.condition} policy, {c.learner}, {c.quantity}",
            "preset": c.preset,
            "median": c.median,
            "by seed": " ".join(f"{value:.3g}" for value in c.values),
            "bound": "" if c.bound is None else f"{c.bound[0]} {c.bound[1]:g}",
            "met": c.met if c.preset == args.preset[0] else None,
        }
        for c in found
    ]
    drawn = [(CAPTION, args.out / f"{progression_files.FIGURE}.png")]
    used = in_short(args.seeds)
    write_study(args.out, "Weight progression", CLAIM, rows, drawn, seeds=used)


def _print(found: Sequence[Check], args: argparse.Namespace) -> None:
    if args.json:
        rows = [{**asdict(c), "median": c.median, "met": c.met} for c in found]
        print(json.dumps(plain({"checks": rows, "out": str(args.out)}), allow_nan=False))
        return
    titles, *rows = progression_files.table(found)
    plain_rows = [[cell.replace("**", "") for cell in row] for row in rows]
    show("Weight progression: median over TOM's seeds (by seed)", titles, plain_rows)
    print(args.out)
