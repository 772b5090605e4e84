"""`tom reproduce tabular`: TOM's weights held against exact ones on small MDPs."""

import argparse
from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Any

from tom.cli.reproduce.study import (
    add_jobs,
    add_output,
    check_seeds,
    out_folder,
    print_json,
    say,
    show_checks,
    stoppable,
)
from tom.cli.tables import show
from tom.reports.files import write_csv
from tom.reports.origin import seeds as in_short
from tom.reports.style import save
from tom.studies import verdicts
from tom.studies.checks import Check
from tom.studies.each import each
from tom.studies.report import write_study
from tom.studies.tabular import (
    VARIANTS,
    Case,
    Estimate,
    Variant,
    acceptance,
    cases,
    estimate,
    summary,
)
from tom.studies.tabular_figure import estimate_figure, estimate_rows

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
    add_jobs(parser)
    add_output(parser, "tabular")
    parser.set_defaults(run=run)


@stoppable
def run(args: argparse.Namespace) -> int:
    check_seeds(args.jobs, [*args.seeds, *args.variant_seeds])
    out_folder(args.out)
    found = _estimates(args)
    same = [e for e in found if e.case.same_policy]
    judged = [e for e in found if e.variant == JUDGED.label and not e.case.same_policy]
    others = [e for e in found if e.variant != JUDGED.label]
    checks = acceptance([e.row() for e in judged], [e.row() for e in same])
    rows = [e.row() for e in (*judged, *others)]
    write_csv(args.out / "estimates.csv", rows)
    write_csv(args.out / "summary.csv", summary(rows))
    write_csv(args.out / "weights.csv", estimate_rows(judged))
    png, _ = save(estimate_figure(judged), args.out, "weights")
    drawn = [("Estimated against exact weights; the area is the replay's share", png)]
    tables = [("Ways to estimate: median and worst", summary(rows))]
    used = in_short(args.seeds)
    judgement = [asdict(check) for check in checks]
    n = f"{len(judged)} problems"
    said = verdicts.tabular(summary(rows))
    write_study(args.out, "Exact weights", CLAIM, said, judgement, drawn, tables, n=n, seeds=used)
    if args.json:
        print_json({"checks": judgement, "verdict": said, "out": str(args.out)})
    else:
        _print(checks, rows, len(judged))
        print("\n".join([*said, str(args.out)]))
    return 0 if all(check.met for check in checks) else 1


def _estimates(args: argparse.Namespace) -> list[Estimate]:
    judged = cases(args.seeds)
    asked = [(replace(case, same_policy=same), JUDGED) for same in (False, True) for case in judged]
    asked += [(case, variant) for variant in VARIANTS[1:] for case in cases(args.variant_seeds)]
    found: list[Estimate] = []
    for one in each(_estimate, asked, args.jobs, args.out):
        found.append(one)
        say(f"{len(found)}/{len(asked)} {one.variant}, MDP {one.case.seed}")
    return found


def _estimate(asked: tuple[Case, Variant]) -> Estimate:
    return estimate(*asked)


def _print(checks: Sequence[Check], rows: Sequence[dict[str, Any]], runs: int) -> None:
    show_checks(f"Estimated against exact weights: {JUDGED.label}, {runs} problems", checks)
    table = summary(rows)
    show(
        "Ways to estimate: median and worst",
        list(table[0]),
        [[v if isinstance(v, str) else f"{v:.3g}" for v in row.values()] for row in table],
    )
