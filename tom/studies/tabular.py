"""TOM's estimated weights against exact ones on small MDPs: the rows of a table, nothing else.

Each row is one MDP under one variant of the estimator; the variants differ in how E_{a'} is taken
and in what theory says must not be done.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.stats import rankdata

from tom.analysis.tabular import (
    Array,
    Mdp,
    Name,
    OccupancyProblem,
    OneHotPolicy,
    occupancy,
    random_mdp,
    random_policy,
    sample_starts,
    sample_transitions,
    solve,
    transition_occupancy,
)
from tom.config import TomConfig
from tom.learners.base import Policy
from tom.learners.tom import occupancy_weights
from tom.studies.checks import Check, at_least, at_most


@dataclass(frozen=True)
class Case:
    """One problem: a random MDP, a random policy and a replay buffer of another one's making."""

    seed: int
    successors: int  # of each (s, a): 1 is deterministic
    discount: float
    divergence: Name
    states: int = 10
    actions: int = 3
    replay: int = 50_000
    policy_buffer: int = 5_000
    starts: int = 1_000
    same_policy: bool = False  # pi = pi_D: every exact weight is 1


@dataclass(frozen=True)
class Variant:
    """A way to estimate: a preset of TomConfig with changes, with or without the exact E_{a'}."""

    label: str
    preset: Literal["paper", "exact"] = "exact"
    changes: Mapping[str, Any] = field(default_factory=dict)
    support: bool = False  # the policy tells its probabilities: E_{a'} is exact


VARIANTS: tuple[Variant, ...] = (
    Variant("exact, exact expectation over a'", support=True),
    Variant("exact, 10 sampled a'"),
    Variant("exact, 1 sampled a'", changes={"action_samples": 1}),
    Variant("exact, semi-gradient", changes={"semi_gradient": True}, support=True),
    Variant("exact, Q >= 0", changes={"q_non_negative": True}, support=True),
    Variant("paper, exact expectation over a'", preset="paper", support=True),
    Variant("paper, 1 sampled a'", preset="paper"),
    Variant("paper, 4 sampled a'", preset="paper", changes={"action_samples": 4}),
    Variant(
        "paper, 1 sampled a', averaged parameters and quick bias",
        preset="paper",
        changes={"parameter_average": 0.99, "q_bias_step": 0.1},
    ),
)


@dataclass(frozen=True)
class Score:
    """How near one estimate came; every sum runs over the replay buffer's rows."""

    spearman: float  # rank correlation of estimated and exact weights
    l1: float  # sum |w - w*| / sum w*
    flow: float  # L1 residual of the Bellman flow constraint under the weighted replay
    log_ratio: float  # correlation of the discriminator's logit and the exact log p/q
    raw_mean: float  # mean weight before normalisation


@dataclass(frozen=True)
class Estimate:
    """A score with the points behind it: the R distinct transitions of the MDP."""

    case: Case
    variant: str
    score: Score
    replay: Array  # q (R,)
    exact: Array  # exact weights (R,)
    estimated: Array  # mean estimated weight of each transition (R,); NaN where none was drawn

    def row(self) -> dict[str, Any]:
        """The flat record: case, variant and score."""
        return {**asdict(self.case), "variant": self.variant, **asdict(self.score)}


def cases(seeds: Iterable[int]) -> list[Case]:
    """Every seed with chi-square and KL, deterministic and stochastic, discount 0.9 and 0.99."""
    return [
        Case(seed, successors, discount, divergence)
        for seed in seeds
        for successors in (1, 3)
        for discount in (0.9, 0.99)
        for divergence in ("chi2", "kl")
    ]


def draw(case: Case, rng: np.random.Generator) -> tuple[Mdp, Array, Array]:
    """The case's MDP, the policy of interest (S, A) and the replay distribution (S, A, S).

    Both policies take every action now and then: of a transition with p of 1e-5 no discriminator
    can know the log ratio from 5 000 of the policy's.
    """
    mdp = random_mdp(case.states, case.actions, case.successors, case.discount, rng)
    target = random_policy(mdp, rng, uniform=0.1)
    behaviour = target if case.same_policy else random_policy(mdp, rng, uniform=0.3)
    return mdp, target, transition_occupancy(mdp, behaviour)


def model_bias(case: Case) -> float:
    """How far the model that the *exact* weights fit is from the true one.

    Mean total variation over the (s, a) of the policy's occupancy. Zero under KL and in
    deterministic MDPs; under chi-square the weights of one (s, a) differ with s'.
    """
    mdp, target, q = draw(case, np.random.default_rng(case.seed))
    problem = OccupancyProblem.of(mdp, target, q)
    model = problem.fitted_model(solve(problem, case.divergence).weights, mdp)
    distance = np.abs(model - mdp.transition).sum(2) / 2
    seen = np.isfinite(distance)
    return float(np.average(distance[seen], weights=occupancy(mdp, target)[seen]))


def estimate(case: Case, variant: Variant) -> Estimate:
    """Draw the case's buffers, estimate their weights and hold them against the exact ones."""
    rng = np.random.default_rng(case.seed)
    mdp, target, q = draw(case, rng)
    problem = OccupancyProblem.of(mdp, target, q)
    buffer, index = sample_transitions(mdp, q, case.replay, rng)
    lately, _ = sample_transitions(mdp, transition_occupancy(mdp, target), case.policy_buffer, rng)
    found = occupancy_weights(
        buffer,
        lately,
        _policy(target, variant.support),
        torch.from_numpy(sample_starts(mdp, case.starts, rng)),
        TomConfig.preset(variant.preset).but(
            discount=case.discount, divergence=case.divergence, **variant.changes
        ),
        torch.Generator().manual_seed(case.seed),
    )
    return _compare(
        case,
        variant,
        problem,
        _rows_of(problem, mdp, index),
        np.asarray(found.weights, np.float64),
        np.asarray(found.log_ratio, np.float64),
        found.metrics["weights/raw_mean"],
    )


def summary(rows: Iterable[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """For each variant, in order: runs, median and worst of each measure."""
    by_variant: dict[str, list[Mapping[str, Any]]] = {}
    for row in rows:
        by_variant.setdefault(row["variant"], []).append(row)
    return [{"variant": name, **_summarise(group)} for name, group in by_variant.items()]


def _summarise(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    column = {name: np.array([row[name] for row in rows]) for name in Score.__annotations__}
    off = np.abs(column["raw_mean"] - 1)
    return {
        "runs": len(rows),
        "spearman": float(np.median(column["spearman"])),
        "spearman_worst": float(column["spearman"].min()),
        "l1": float(np.median(column["l1"])),
        "l1_worst": float(column["l1"].max()),
        "flow": float(np.median(column["flow"])),
        "flow_worst": float(column["flow"].max()),
        "log_ratio": float(np.median(column["log_ratio"])),
        "log_ratio_worst": float(column["log_ratio"].min()),
        "raw_mean": float(np.median(column["raw_mean"])),
        "raw_mean_worst": float(column["raw_mean"][off.argmax()]),
    }


def _policy(probs: Array, support: bool) -> Policy:
    policy = OneHotPolicy(torch.from_numpy(probs).float())
    # A bound method offers no `support`: what remains is a policy that can only be sampled.
    return policy if support else policy.__call__


def _rows_of(problem: OccupancyProblem, mdp: Mdp, index: NDArray[np.intp]) -> NDArray[np.intp]:
    """Which of the R distinct transitions each buffer row is, (N,)."""
    lookup = np.full((mdp.states, mdp.actions, mdp.states), -1, np.intp)
    lookup[problem.index] = np.arange(len(problem.replay))
    return lookup[tuple(index.T)]


def _compare(
    case: Case,
    variant: Variant,
    problem: OccupancyProblem,
    rows: NDArray[np.intp],
    weights: Array,
    log_ratio: Array,
    raw_mean: float,
) -> Estimate:
    exact = solve(problem, case.divergence).weights
    exact = exact / (problem.replay @ exact)
    cells = len(problem.replay)
    count = np.bincount(rows, minlength=cells)
    mass = np.bincount(rows, weights, minlength=cells) / len(rows)  # of the weighted replay
    score = Score(
        spearman=_correlation(rankdata(weights), rankdata(exact[rows])),
        l1=float(np.abs(weights - exact[rows]).sum() / exact[rows].sum()),
        flow=float(np.abs(problem.residual(mass / problem.replay)).sum()),
        log_ratio=_correlation(log_ratio, problem.log_ratio[rows]),
        raw_mean=raw_mean,
    )
    with np.errstate(invalid="ignore"):
        estimated = mass * len(rows) / count
    return Estimate(case, variant.label, score, problem.replay, exact, estimated)


def _correlation(x: Array, y: Array) -> float:
    return float(np.corrcoef(x, y)[0, 1])


def acceptance(
    rows: Sequence[Mapping[str, Any]], same_policy: Sequence[Mapping[str, Any]]
) -> list[Check]:
    """The figures an estimator is held against.

    `same_policy` are the rows of problems where the policy made the replay buffer itself.
    """
    s = _summarise(rows)
    off = max(abs(row["raw_mean"] - 1) for row in rows)
    same = max(row["l1"] for row in same_policy)
    return [
        at_least("rank correlation of the weights, median", s["spearman"], 0.95),
        at_least("rank correlation of the weights, worst", s["spearman_worst"], 0.90),
        at_most("relative L1 error, median", s["l1"], 0.12),
        at_most("relative L1 error, worst", s["l1_worst"], 0.20),
        at_most("Bellman flow residual, worst", s["flow_worst"], 0.12),
        at_least("logit against log ratio, worst", s["log_ratio_worst"], 0.95),
        at_most("mean weight off 1, worst", off, 0.05),
        at_most("pi = pi_D: relative L1 distance from 1, worst", same, 0.12),
    ]
