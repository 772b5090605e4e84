"""`tom reproduce tabular`: TOM's weights held against exact ones on small MDPs."""

import argparse
import json
import os
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import torch

from tom.cli.study import out_folder
from tom.cli.tables import show
from tom.errors import UserError
from tom.matmul import choose_matmul
from tom.record.files import plain
from tom.reports.files import write_csv
from tom.reports.origin import seeds as in_short
from tom.reports.study import write_study
from tom.reports.style import save
from tom.reports.tabular import estimate_figure
from tom.studies.tabular import VARIANTS, Estimate, Variant, acceptance, cases, estimate, summary

JUDGED = VARIANTS[0]
CLAIM = (
    "At the optimum of the dual, f*' of the Bellman residual is the ratio of the optimal "
    "transition occupancy to the replay buffer's (section 4.3). The paper gives no numbers; here "
    "the estimate is held against the exact ratio of small MDPs."
)


def add_parser(subparsers, arguments: list[str]) -> None:
    parser = subparsers.add_parser(
        "tabular",
        help="estimated against exact weights on small MDPs",
        description="Estimate TOM's weights on small MDPs with a known solution (chi-square "
        "and KL, stochastic and deterministic, discount 0.9 and 0.99; 50 000 replay and 5 000 "
        "policy transitions) and hold them against the acceptance; other ways to estimate, the "
        "paper preset among them, stand beside it.",
    )
    parser.add_argument(
        "--seeds", nargs="+", type=int, default=list(range(6)), help="MDPs [0 .. 5]"
    )
    parser.add_argument(
        "--variant-seeds", nargs="*", type=int, default=[0, 1], help="MDPs of the other ways [0 1]"
    )
    parser.add_argument("--jobs", type=int, default=len(os.sched_getaffinity(0)))
    parser.add_argument("--out", type=Path, default=Path("reports/tabular"))
    parser.add_argument("--json", action="store_true", help="print the checks as JSON")
    parser.set_defaults(run=run)


def run(args: argparse.Namespace) -> int:
    if min([*args.seeds, *args.variant_seeds]) < 0 or args.jobs < 1:
        raise UserError("--seeds and --variant-seeds must be at least 0 and --jobs at least 1")
    out_folder(args.out)
    with ProcessPoolExecutor(args.jobs, get_context("spawn"), _prepare) as pool:
        judged = _estimates(pool, JUDGED, args.seeds)
        same = _estimates(pool, JUDGED, args.seeds, same_policy=True)
        others = [e for v in VARIANTS[1:] for e in _estimates(pool, v, args.variant_seeds)]
    checks = acceptance([e.row() for e in judged], [e.row() for e in same])
    rows = [e.row() for e in (*judged, *others)]
    write_csv(args.out / "estimates.csv", rows)
    write_csv(args.out / "summary.csv", summary(rows))
    png, _ = save(estimate_figure(judged), args.out, "weights")
    drawn = [("Estimated against exact weights; the area is the replay's share", png)]
    tables = [("Ways to estimate: median and worst", summary(rows))]
    used = in_short(args.seeds)
    write_study(args.out, "Exact weights", CLAIM, checks, drawn, tables, seeds=used)
    if args.json:
        print(json.dumps(plain({"checks": checks, "out": str(args.out)}), allow_nan=False))
    else:
        _print(checks, rows, len(judged))
        print(args.out)
    return 0 if all(check["met"] for check in checks) else 1


def _estimates(
    pool: ProcessPoolExecutor, variant: Variant, seeds: Sequence[int], same_policy: bool = False
) -> list[Estimate]:
    chosen = [replace(case, same_policy=same_policy) for case in cases(seeds)]
    found = []
    for done in pool.map(partial(_estimate, variant), chosen):
        found.append(done)
        print(f"{variant.label}: {len(found)}/{len(chosen)}", file=sys.stderr, flush=True)
    return found


def _estimate(variant: Variant, case) -> Estimate:
    return estimate(case, variant)


def _prepare() -> None:
    torch.set_num_threads(1)
    choose_matmul()


def _print(checks: Sequence[dict[str, Any]], rows: Sequence[dict[str, Any]], runs: int) -> None:
    show(
        f"Estimated against exact weights: {JUDGED.label}, {runs} problems",
        ("figure", "value", "bound", "met"),
        [(c["name"], f"{c['value']:.3g}", c["bound"], "yes" if c["met"] else "NO") for c in checks],
    )
    table = summary(rows)
    show(
        "Ways to estimate: median and worst",
        list(table[0]),
        [[v if isinstance(v, str) else f"{v:.3g}" for v in row.values()] for row in table],
    )
