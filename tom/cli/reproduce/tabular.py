"""`tom reproduce tabular`: TOM's weights compared with exact ones on small MDPs."""

import argparse
from collections.abc import Sequence
from dataclasses import asdict, replace
from typing import Any, get_args

from tom.cli.reproduce.study import (
    Distinct,
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
from tom.learners.discriminator import Inputs
from tom.reports.files import write_csv
from tom.reports.origin import seeds as in_short
from tom.reports.style import save
from tom.studies import verdicts
from tom.studies.each import each
from tom.studies.report import write_study
from tom.studies.tabular import Estimate, counted, estimate
from tom.studies.tabular_figure import estimate_figure, estimate_rows
from tom.studies.tabular_flows import exact_flows
from tom.studies.tabular_problems import Case, cases, dense_cases, ending_cases
from tom.studies.tabular_summary import acceptance, summary
from tom.studies.tabular_variants import DENSE, ENDING, ENDING_PAPER, MENDED, VARIANTS, Variant

JUDGED = VARIANTS[0]
CLAIM = (
    "At the optimum of the dual, f*' of the Bellman residual is the ratio of the optimal "
    "transition occupancy to the replay buffer's (section 4.3). The paper gives no numbers; here "
    "the estimate is held against the exact ratio of small MDPs."
)

WAYS = "Ways to estimate: median and worst"
FLOWS = (
    "Exact weights of each flow, both buffers streams as collected, chi-square: on ends over the "
    "policy's share, mass, and of the policy's own stream, which should weigh one"
)


def add_parser(subparsers, arguments: list[str]) -> None:
    parser = subparsers.add_parser(
        "tabular",
        help="estimated against exact weights on small MDPs",
        description="Estimate TOM's weights on small MDPs with a known solution (chi-square "
        "and KL, stochastic and deterministic, discount 0.9 and 0.99; 50 000 replay and 5 000 "
        "policy transitions), on dense ones, and on ones where a step in a hundred ends an episode "
        "under all three flows, and hold them against the acceptance; other ways to estimate, the "
        "paper preset among them, stand beside it.",
    )
    parser.add_argument(
        "--seeds",
        nargs="+",
        type=int,
        action=Distinct,
        default=list(range(6)),
        help="MDPs [0 .. 5]",
    )
    parser.add_argument(
        "--variant-seeds",
        nargs="*",
        type=int,
        action=Distinct,
        default=[0, 1],
        help="MDPs of the rest [0 1]",
    )
    add_jobs(parser)
    add_output(parser, "tabular")
    parser.set_defaults(run=run)


@stoppable
def run(args: argparse.Namespace) -> int:
    check_seeds(args.jobs, [*args.seeds, *args.variant_seeds])
    out_folder(args.out)
    estimates = _estimates(args)
    rows = [e.row() for e in estimates if not e.case.same_policy] + _counted(args)
    judged = _of(estimates, JUDGED)
    checks = acceptance(
        [e.row() for e in judged],
        [e.row() for e in estimates if e.case.same_policy],
        *([e.row() for e in _of(estimates, way)] for way in (DENSE, ENDING["stationary"], MENDED)),
    )
    write_csv(args.out / "estimates.csv", rows)
    write_csv(args.out / "summary.csv", summary(rows))
    flows = exact_flows(args.seeds)
    write_csv(args.out / "flows.csv", flows)
    write_csv(args.out / "weights.csv", estimate_rows(judged))
    png, _ = save(estimate_figure(judged), args.out, "weights")
    drawn = [("Estimated against exact weights; the area is the replay's share", png)]
    tables = [(WAYS, summary(rows)), (FLOWS, flows)]
    used = in_short(args.seeds)
    judgement = [asdict(check) for check in checks]
    n = f"{len(rows)} estimates"
    said = verdicts.tabular(summary(rows))
    write_study(args.out, "Exact weights", CLAIM, said, judgement, drawn, tables, n=n, seeds=used)
    if args.json:
        print_json({"checks": judgement, "verdict": said, "out": str(args.out)})
    else:
        show_checks(f"Estimated against exact weights: {len(rows)} estimates", checks)
        for title, table in tables:
            show(title, list(table[0]), [[_shown(v) for v in row.values()] for row in table])
        print("\n".join([*said, str(args.out)]))
    return 0 if all(check.met for check in checks) else 1


def _estimates(args: argparse.Namespace) -> list[Estimate]:
    asked = _asked(args.seeds, args.variant_seeds)
    estimates: list[Estimate] = []
    for one in each(_estimate, asked, args.jobs, args.out):
        estimates.append(one)
        say(f"{len(estimates)}/{len(asked)} {one.variant}, MDP {one.case.seed}")
    return estimates


def _asked(seeds: Sequence[int], fewer: Sequence[int]) -> list[tuple[Case, Variant]]:
    """Every case with its variant; those of the acceptance come first, with all seeds."""
    judged, ends = cases(seeds), ending_cases(seeds, "stationary")
    asked = [(case, JUDGED) for case in judged]
    asked += [(case, way) for way in (ENDING["stationary"], MENDED) for case in ends]
    asked += [(case, DENSE) for case in dense_cases(fewer)]
    for flow in ("restart", "discounted"):
        asked += [(case, ENDING[flow]) for case in ending_cases(fewer, flow)]
    asked += [(case, ENDING_PAPER) for case in ending_cases(fewer, "discounted")]
    asked += [(replace(case, same_policy=True), JUDGED) for case in judged]
    asked += [(case, variant) for variant in VARIANTS[1:] for case in cases(fewer)]
    return asked


def _of(estimates: Sequence[Estimate], way: Variant) -> list[Estimate]:
    return [e for e in estimates if e.variant == way.label and not e.case.same_policy]


def _counted(args: argparse.Namespace) -> list[dict[str, Any]]:
    """The sampling error of every family, from counts of (s, a) and of (s, a, s')."""
    families = cases(args.seeds), dense_cases(args.variant_seeds)
    every = [*families, ending_cases(args.seeds, "stationary")]
    asked: list[tuple[Case, Inputs]] = [
        (case, of) for family in every for of in get_args(Inputs) for case in family
    ]
    return [estimate.row() for estimate in each(_count, asked, args.jobs, args.out)]


def _count(asked: tuple[Case, Inputs]) -> Estimate:
    return counted(*asked)


def _estimate(asked: tuple[Case, Variant]) -> Estimate:
    return estimate(*asked)


def _shown(value: str | float | None) -> str:
    if value is None:
        return "-"
    return value if isinstance(value, str) else f"{value:.3g}"
