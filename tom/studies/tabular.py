"""TOM's estimated weights against exact ones on a small MDP: draw buffers, estimate, compare.

An estimate is that of one variant of the estimator, or the exact weights with r from counts.

If no episode ends, both buffers are draws from discounted occupancies, as the theory requires. If
episodes end, both are streams in order, as in training, for every flow.
"""

from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.stats import rankdata

from tom.analysis.exact_weights import OccupancyProblem, solve
from tom.analysis.tabular import (
    Array,
    Mdp,
    OneHotPolicy,
    sample_starts,
    sample_stream,
    sample_transitions,
    transition_occupancy,
)
from tom.data.transitions import Transitions
from tom.learners.base import Policy
from tom.learners.discriminator import Inputs
from tom.learners.tom import occupancy_weights
from tom.studies.tabular_problems import Case, draw, problem_of, share_on
from tom.studies.tabular_variants import Variant


@dataclass(frozen=True)
class Score:
    """The quality of one estimate; every sum runs over the replay buffer's rows."""

    spearman: float  # rank correlation of estimated and exact weights
    l1: float  # sum |w - w*| / sum w*
    flow_residual: float  # L1 residual of the flow constraint under the weighted replay
    log_ratio: float  # correlation of the discriminator's logit and the exact log p/q
    raw_mean: float  # mean weight before normalisation, relative to the exact mean
    ends_ratio: float | None  # weight on transitions that end an episode over the exact one


@dataclass(frozen=True)
class Estimate:
    """A score with its points: the R distinct transitions of the MDP."""

    case: Case
    variant: str
    score: Score
    replay: Array  # q (R,)
    exact: Array  # exact weights (R,)
    estimated: Array  # mean estimated weight of each transition (R,); NaN if it was not drawn

    def row(self) -> dict[str, Any]:
        """The flat record: case, variant and score."""
        return {**asdict(self.case), "variant": self.variant, **asdict(self.score)}


def estimate(case: Case, variant: Variant) -> Estimate:
    """Draw the case's buffers, estimate their weights and compare them with the exact ones."""
    drawn = _draw(case)
    weights = occupancy_weights(
        drawn.buffer,
        drawn.lately,
        _policy(drawn.target, variant.support),
        torch.from_numpy(drawn.starts),
        variant.config(case),
        torch.Generator().manual_seed(case.seed),
    )
    return _compare(
        case,
        variant.label,
        drawn,
        np.asarray(weights.weights, np.float64),
        np.asarray(weights.log_ratio, np.float64),
        weights.metrics["weights/raw_mean"],
    )


def counted(case: Case, inputs: Inputs) -> Estimate:
    """The exact weights of the case's problem, with r from counts in its buffers.

    This is the sampling error, which no estimate of r from these inputs can improve by much.
    """
    drawn = _draw(case)
    problem, rows = drawn.problem, tuple(drawn.index.T)
    q, p = _counts(drawn, drawn.index), _counts(drawn, drawn.recent)
    if inputs == "state-actions":
        q, p = (np.broadcast_to(x.sum(2, keepdims=True), x.shape) for x in (q, p))
    # Add half a transition to the policy's counts and the corresponding number to the replay's, so
    # that r is finite, and zero for transitions in neither buffer.
    share = len(drawn.recent) / len(drawn.index)
    ratio = np.log((p + 0.5) / (q * share + 0.5))
    weights = np.zeros(q.shape)
    noisy = replace(problem, log_ratio=ratio[problem.index])
    weights[problem.index] = solve(noisy, case.divergence).weights
    mean = float(weights[rows].mean())
    read = "(s, a)" if inputs == "state-actions" else "(s, a, s')"
    label = f"{case.family}counts of {read}"
    return _compare(case, label, drawn, weights[rows] / mean, ratio[rows], mean)


@dataclass(frozen=True)
class Drawn:
    """A case's problem and the buffers drawn for it."""

    mdp: Mdp
    target: Array  # the policy (S, A)
    problem: OccupancyProblem
    buffer: Transitions  # the replay, (N,)
    index: NDArray[np.intp]  # (N, 3)
    lately: Transitions  # the policy's
    recent: NDArray[np.intp]  # (P, 3)
    starts: NDArray[np.float32]


def _draw(case: Case) -> Drawn:
    rng = np.random.default_rng(case.seed)
    mdp, target, behaviour = draw(case, rng)
    buffer, index = _sample(case, mdp, behaviour, case.replay, rng)
    lately, recent = _sample(case, mdp, target, case.policy_buffer, rng)
    starts = sample_starts(mdp, case.starts, rng)
    problem = problem_of(case, mdp, target, behaviour)
    return Drawn(mdp, target, problem, buffer, index, lately, recent, starts)


def _counts(drawn: Drawn, index: NDArray[np.intp]) -> Array:
    """The count of each (s, a, s') in a buffer, (S, A, S)."""
    counts = np.zeros(drawn.mdp.transition.shape)
    np.add.at(counts, tuple(index.T), 1)
    return counts


def _sample(
    case: Case, mdp: Mdp, policy: Array, n: int, rng: np.random.Generator
) -> tuple[Transitions, NDArray[np.intp]]:
    if case.ends:
        return sample_stream(mdp, policy, n, rng)
    return sample_transitions(mdp, transition_occupancy(mdp, policy), n, rng)


def _policy(probs: Array, support: bool) -> Policy:
    policy = OneHotPolicy(torch.from_numpy(probs).float())
    # A bound method has no `support`, so that the policy can only be sampled.
    return policy if support else policy.__call__


def _rows_of(problem: OccupancyProblem, mdp: Mdp, index: NDArray[np.intp]) -> NDArray[np.intp]:
    """The index of each buffer row among the R distinct transitions, (N,)."""
    lookup = np.full((mdp.states, mdp.actions, mdp.states), -1, np.intp)
    lookup[problem.index] = np.arange(len(problem.replay))
    return lookup[tuple(index.T)]


def _compare(
    case: Case, label: str, drawn: Drawn, weights: Array, log_ratio: Array, raw_mean: float
) -> Estimate:
    problem = drawn.problem
    rows = _rows_of(problem, drawn.mdp, drawn.index)
    ends = drawn.mdp.terminal[drawn.index[:, 2]]
    exact = solve(problem, case.divergence).weights
    flow_mass = float(problem.replay @ exact)  # below 1 if the flow loses mass at ends
    exact = exact / flow_mass
    cells = len(problem.replay)
    count = np.bincount(rows, minlength=cells)
    mass = np.bincount(rows, weights, minlength=cells) / len(rows)  # of the weighted replay
    score = Score(
        spearman=_correlation(rankdata(weights), rankdata(exact[rows])),
        l1=float(np.abs(weights - exact[rows]).sum() / exact[rows].sum()),
        flow_residual=float(np.abs(problem.residual(flow_mass * mass / problem.replay)).sum()),
        log_ratio=_correlation(log_ratio, problem.log_ratio[rows]),
        raw_mean=raw_mean / flow_mass,
        ends_ratio=share_on(ends, weights) / share_on(ends, exact[rows]) if ends.any() else None,
    )
    with np.errstate(invalid="ignore"):
        estimated = mass * len(rows) / count
    return Estimate(case, label, score, problem.replay, exact, estimated)


def _correlation(x: Array, y: Array) -> float:
    return float(np.corrcoef(x, y)[0, 1])
