"""The exact weights of each flow, if both buffers are streams with ends."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, get_args

import numpy as np

from tom.analysis.exact_weights import solve
from tom.analysis.tabular import FlowName
from tom.studies.tabular_problems import Case, draw, ending_cases, problem_of, share_on


def exact_flows(seeds: Sequence[int]) -> list[dict[str, Any]]:
    """The exact weights of each flow under chi-square, if both buffers are streams with ends.

    One row per flow over the MDPs of `ending_cases`: the weight on ends relative to the policy's
    share (median and range), the mass of the weights, and for a replay made by the policy itself,
    where weights should be one, the weight on ends relative to their share and the L1 distance to
    one.
    """
    return [_exact_flow(ending_cases(seeds, flow), flow) for flow in get_args(FlowName)]


def _exact_flow(asked: Sequence[Case], flow: FlowName) -> dict[str, Any]:
    solved = [_solved(case) for case in asked if case.divergence == "chi2"]
    own = [_solved(replace(case, same_policy=True)) for case in asked if case.divergence == "chi2"]
    ends, mass, _ = np.array(solved).T
    own_ends, _, own_l1 = np.median(own, axis=0)
    return {
        "flow": flow,
        "problems": len(solved),
        "ends": float(np.median(ends)),
        "ends_least": float(ends.min()),
        "ends_most": float(ends.max()),
        "mass": float(np.median(mass)),
        "own_ends": float(own_ends),
        "own_l1": float(own_l1),
    }


def _solved(case: Case) -> tuple[float, float, float]:
    """Exact weight on ends relative to the policy's share, mass, and L1 distance to p/q."""
    mdp, target, behaviour = draw(case, np.random.default_rng(case.seed))
    problem = problem_of(case, mdp, target, behaviour)
    weights = solve(problem, case.divergence).weights
    mass, ratio = float(problem.replay @ weights), np.exp(problem.log_ratio)
    weights, ends = weights / mass, mdp.terminal[problem.index[2]]
    share = share_on(ends, problem.replay * weights) / share_on(ends, problem.replay * ratio)
    return share, mass, float(problem.replay @ np.abs(weights - ratio))
