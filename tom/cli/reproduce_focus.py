"""`tom reproduce focus`: does weighting make the model better where the policy goes?"""

import argparse
import json
from dataclasses import asdict
from pathlib import Path

import torch

from tom.cli.study import out_folder, sac_recordings, say, stoppable
from tom.cli.tables import show
from tom.envs import task
from tom.errors import UserError
from tom.matmul import choose_matmul
from tom.record import Store
from tom.record.files import plain
from tom.reports.files import write_csv
from tom.reports.focus import error_figure
from tom.reports.style import save
from tom.studies.focus import QUANTITIES, RIVALS, Focus, study, summary
from tom.studies.progression import SAC_SEEDS


def add_parser(subparsers, arguments: list[str]) -> None:
    parser = subparsers.add_parser(
        "focus",
        help="model error where the policy goes, for every learner on the same buffer",
        description="Weigh the replay buffer of SAC recordings (made where the store has none) for "
        "the policy that SAC ended with, fit the paper's model afresh with each learner's weights, "
        "and measure its error on transitions that the policy makes anew and on the buffer's two "
        "halves. Nothing is accepted or refused: it says for whom weighting helped, and where.",
    )
    parser.add_argument("--env", nargs="+", default=list(SAC_SEEDS), metavar="ENV")
    parser.add_argument("--steps", type=int, default=50_000, help="steps of SAC [50000]")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2], help="[0 1 2]")
    parser.add_argument("--store", type=Path, default=Path("runs"), help="run store (runs/)")
    parser.add_argument("--out", type=Path, default=Path("reports/focus"))
    parser.add_argument("--json", action="store_true", help="print the summary as JSON")
    parser.set_defaults(run=run)


@stoppable
def run(args: argparse.Namespace) -> int:
    if args.steps < 1000 or min(args.seeds) < 0:
        raise UserError("--steps must be at least 1000 and --seeds at least 0")
    envs = [task(env).name for env in args.env]
    out_folder(args.out)
    runs = sac_recordings(Store(args.store), envs, None, args.steps)
    torch.set_num_threads(1)
    choose_matmul()
    found: list[Focus] = []
    for reader in runs:
        for one in study(reader, RIVALS, args.seeds):
            found.append(one)
            say(f"{one.recording}: {one.rival} seed {one.seed}")
    _write_and_print(found, args)
    return 0


def _write_and_print(found: list[Focus], args: argparse.Namespace) -> None:
    rows = summary(found)
    write_csv(args.out / "errors.csv", [asdict(one) for one in found])
    write_csv(args.out / "summary.csv", rows)
    save(error_figure(found), args.out, "errors")
    if args.json:
        print(json.dumps(plain({"summary": rows, "out": str(args.out)}), allow_nan=False))
        return
    show(
        f"Model error, median over seeds {' '.join(map(str, args.seeds))} (over MLE's)",
        ("recording", "learner", "ESS", *QUANTITIES.values()),
        [
            (
                str(row["recording"]),
                str(row["rival"]),
                f"{row['ess']:.3f}",
                *(f"{row[q]:.3f} ({row[f'{q} / mle']:.2f})" for q in QUANTITIES),
            )
            for row in rows
        ],
    )
    print(args.out)
