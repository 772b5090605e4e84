"""Does TOM's estimator find the weights that its theory defines? Small MDPs with known solutions.

Chi-square and KL, stochastic and deterministic, discount 0.9 and 0.99; 50 000 replay and 5 000
policy transitions; dense MDPs, and ones where a step in a hundred ends an episode under all three
flows. The estimates are judged by the acceptance; other ways to estimate, including the paper
preset, are shown for comparison.
"""

from argparse import ArgumentParser, Namespace
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import groupby
from typing import get_args

import numpy as np
from matplotlib.figure import Figure

from tom.learners.terms import DIVERGENCES
from tom.reports.figures import NEUTRAL, learner_colour, new_figure
from tom.reports.report import in_short
from tom.studies.mdp import FlowName, solve
from tom.studies.study import Findings, Row, add_jobs, check, compute
from tom.studies.tabular_estimates import (
    DENSE,
    ENDING,
    ENDING_PAPER,
    MENDED,
    PAPER,
    VARIANTS,
    Case,
    Estimate,
    Inputs,
    Variant,
    cases,
    counts_of,
    dense_cases,
    draw,
    ending_cases,
    estimate,
    problem_of,
    share_on,
)
from tom.studies.tabular_ways import exact_ways
from tom.studies.verdicts import by_acceptance

TITLE = "Exact weights"
QUESTION = "Are the estimated weights exact on small MDPs?"
CLAIM = (
    "At the optimum of the dual, f*' of the Bellman residual is the ratio of the optimal "
    "transition occupancy to the replay buffer's (section 4.3). The paper gives no numbers; here "
    "the estimate is held against the exact ratio of small MDPs."
)
JUDGED = VARIANTS[0]
WAYS = "Ways to estimate: median and worst"
FLOWS = (
    "Exact weights of each flow, both buffers streams as collected, chi-square: on ends over the "
    "policy's share, mass, and of the policy's own stream, which should weigh one"
)
UNTRAINED = (
    "Exact weights of ways that train no network (replay: a mixture of drifting policies): total "
    "variation to the policy's stream, weight on ends over its share, effective sample (medians)"
)
CAPTION = "Estimated against exact weights; the area is the replay's share"

verdict = by_acceptance


def add_options(parser: ArgumentParser) -> None:
    few = list(range(6))
    parser.add_argument(
        "--seeds", nargs="+", type="seed", default=few, help="seeds of the MDPs [0 .. 5]"
    )
    parser.add_argument(
        "--variant-seeds",
        nargs="*",
        type="seed",
        default=[0, 1],
        help="seeds of the other ways' MDPs [0 1]",
    )
    add_jobs(parser)


def find(args: Namespace) -> Findings:
    every = compute(
        args,
        estimate,
        _all_cases(args.seeds, args.variant_seeds),
        lambda one: f"{one.row['variant']}, MDP {one.row['seed']}",
    )
    same = [one.row for one in every if one.row["same_policy"]]
    others = [one for one in every if not one.row["same_policy"]]
    rows, drawn = (
        [one.row for one in others],
        [one for one in others if one.row["variant"] == JUDGED.label],
    )
    table = summary(rows)
    return Findings(
        sentences=in_sentences(table),
        files={
            "estimates": rows,
            "summary": table,
            "flows": exact_flows(args.seeds),
            "ways": exact_ways(args.seeds),
            "weights": _points(drawn),
        },
        titles={"summary": WAYS, "flows": FLOWS, "ways": UNTRAINED},
        figures={"weights": (CAPTION, estimate_figure(drawn))},
        checks=acceptance(rows, same),
        origin={"n": f"{len(rows)} estimates", "seeds": in_short(args.seeds)},
    )


def _all_cases(seeds: Sequence[int], fewer: Sequence[int]) -> list[tuple[Case, Variant]]:
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
    for family in (judged, dense_cases(fewer), ends):
        asked += [(case, counts_of(case, of)) for of in get_args(Inputs) for case in family]
    return asked


def exact_flows(seeds: Sequence[int]) -> list[Row]:
    """The exact weights of each flow under chi-square, if both buffers are streams with ends.

    One row per flow over the MDPs of `ending_cases`: the weight on ends relative to the policy's
    share (median and range), the mass of the weights, and for a replay made by the policy itself,
    where weights should be one, the weight on ends relative to their share and the L1 distance to
    one.
    """
    rows = []
    for flow in get_args(FlowName):
        asked = [case for case in ending_cases(seeds, flow) if case.divergence == "chi2"]
        ends, mass, _ = np.array([_solved(case) for case in asked]).T
        own = [_solved(replace(case, same_policy=True)) for case in asked]
        own_ends, _, own_l1 = np.median(own, axis=0)
        rows.append(
            {
                "flow": flow,
                "problems": len(asked),
                "ends": float(np.median(ends)),
                "ends_least": float(ends.min()),
                "ends_most": float(ends.max()),
                "mass": float(np.median(mass)),
                "own_ends": float(own_ends),
                "own_l1": float(own_l1),
            }
        )
    return rows


def _solved(case: Case) -> tuple[float, float, float]:
    """Exact weight on ends relative to the policy's share, mass, and L1 distance to p/q."""
    mdp, target, behaviour = draw(case, np.random.default_rng(case.seed))
    problem = problem_of(case, mdp, target, behaviour)
    weights = solve(problem, case.divergence).weights
    mass, ratio = float(problem.replay @ weights), np.exp(problem.log_ratio)
    weights, ends = weights / mass, mdp.terminal[problem.index[2]]
    share = share_on(ends, problem.replay * weights) / share_on(ends, problem.replay * ratio)
    return share, mass, float(problem.replay @ np.abs(weights - ratio))


def summary(rows: Sequence[Row]) -> list[Row]:
    """For each variant, in order: number of runs, median and worst value of each measure.

    Those of the mean weight are over the runs without KL, under which it is 1 whatever the error.
    """
    by_variant: dict[str, list[Row]] = {}
    for row in rows:
        by_variant.setdefault(row["variant"], []).append(row)
    return [{"variant": name, **_brief(group)} for name, group in by_variant.items()]


def _brief(rows: Sequence[Row]) -> Row:
    brief: Row = {"runs": len(rows)}
    for name, worst in (("spearman", min), ("l1", max), ("flow_residual", max), ("log_ratio", min)):
        values = [row[name] for row in rows]
        brief |= {name: float(np.median(values)), f"{name}_worst": worst(values)}
    for name in ("raw_mean", "ends_ratio"):  # 1 without an error
        of = [row for row in rows if name != "raw_mean" or row["divergence"] != "kl"]
        known = [row[name] for row in of if row[name] is not None]
        brief |= {
            name: float(np.median(known)) if known else None,
            f"{name}_worst": max(known, key=lambda ratio: abs(ratio - 1), default=None),
        }
    return brief


def acceptance(rows: Sequence[Row], same_policy: Sequence[Row]) -> list[Row]:
    """The checks of an estimator, over every family that has rows.

    `same_policy` are problems whose replay buffer comes from the policy itself.
    """

    def of(variant: Variant) -> list[Row]:
        return [row for row in rows if row["variant"] == variant.label]

    checks = near_exact("", of(JUDGED))
    if same_policy:
        same = max(row["l1"] for row in same_policy)
        checks.append(check("pi = pi_D: relative L1 distance from 1, worst", same, "<=", 0.12))
    checks += near_exact("dense: ", of(DENSE))
    checks += near_exact("stationary: ", of(ENDING["stationary"]))
    for name, variant in (("stationary", ENDING["stationary"]), ("mended", MENDED)):
        if group := of(variant):
            off = abs(float(np.median([row["ends_ratio"] for row in group])) - 1)
            checks.append(check(f"{name}: weight on ends off the exact, median", off, "<=", 0.20))
    return checks


def near_exact(family: str, rows: Sequence[Row]) -> list[Row]:
    """The checks of one family of problems; none if it has no rows."""
    if not rows:
        return []
    s = _brief(rows)
    off = max(abs(row["raw_mean"] - 1) for row in rows)
    return [
        check(f"{family}rank correlation of the weights, median", s["spearman"], ">=", 0.95),
        check(f"{family}rank correlation of the weights, worst", s["spearman_worst"], ">=", 0.90),
        check(f"{family}relative L1 error, median", s["l1"], "<=", 0.12),
        check(f"{family}relative L1 error, worst", s["l1_worst"], "<=", 0.20),
        check(f"{family}flow residual, worst", s["flow_residual_worst"], "<=", 0.12),
        check(f"{family}logit against log ratio, worst", s["log_ratio_worst"], ">=", 0.95),
        check(f"{family}mean weight off the exact, worst", off, "<=", 0.05),
    ]


def in_sentences(table: Sequence[Row]) -> list[str]:
    """How exact the estimates are, of the estimator that is judged and as the paper has it."""
    return [
        f"{row['variant']}: rank correlation {row['spearman']:.2f}, relative L1 error "
        f"{row['l1']:.2f} (medians)."
        for row in table
        if row["variant"] in (JUDGED.label, PAPER)
    ]


def _points(estimates: Sequence[Estimate]) -> Iterator[Row]:
    """The drawn data: one row per distinct transition in the replay."""
    for one in estimates:
        key = {name: one.row[name] for name in ("divergence", "discount", "seed", "successors")}
        points = zip(one.exact, one.estimated, one.replay, strict=True)
        for exact, estimated, share in points:
            if np.isfinite(estimated):
                yield {**key, "exact": exact, "estimated": estimated, "replay's share": share}


def estimate_figure(estimates: Sequence[Estimate]) -> Figure:
    """A panel per divergence and discount; each distinct transition is a point."""

    def kind_of(one: Estimate) -> tuple[str, float]:
        return one.row["divergence"], one.row["discount"]

    kinds = groupby(sorted(estimates, key=kind_of), kind_of)
    panels = {kind: list(own) for kind, own in kinds}
    figure = new_figure(2.6 * len(panels) + 0.3, 3.0)
    axes = figure.subplots(1, len(panels), squeeze=False)[0]
    for ax, ((divergence, discount), own) in zip(axes, panels.items(), strict=True):
        points = [(one.exact, one.estimated, one.replay) for one in own]
        exact, estimated, share = np.concatenate(points, axis=1)
        drawn = np.isfinite(estimated)
        top = 1.05 * float(max(exact[drawn].max(), estimated[drawn].max()))
        ax.plot([0, top], [0, top], color=NEUTRAL, linewidth=0.8, linestyle="--")
        ax.scatter(
            exact[drawn],
            estimated[drawn],
            s=400 * share[drawn],
            color=learner_colour("tom"),
            alpha=0.35,
            linewidths=0,
        )
        ax.set_title(f"{DIVERGENCES[divergence].label}, discount {discount:g}")
        ax.set_xlabel("exact weight")
    axes[0].set_ylabel("estimated weight")
    return figure
