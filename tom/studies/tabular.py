"""TOM's estimated weights against exact ones on small MDPs, as rows of a table.

Each row is one MDP with one variant of the estimator. The variants differ in how E_{a'} is taken,
and some do what theory forbids.

If no episode ends, both buffers are draws from discounted occupancies, as the theory requires. If
episodes end, both are streams in order, as in training, for every flow.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal, get_args

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.stats import rankdata

from tom.analysis.tabular import (
    Array,
    FlowName,
    Mdp,
    Name,
    OccupancyProblem,
    OneHotPolicy,
    random_mdp,
    random_policy,
    sample_starts,
    sample_stream,
    sample_transitions,
    solve,
    transition_occupancy,
    with_endings,
)
from tom.config import TomConfig
from tom.data.transitions import Transitions
from tom.learners.base import Policy
from tom.learners.tom import occupancy_weights
from tom.studies.checks import Check, at_least, at_most
from tom.training.presets import PRESETS


@dataclass(frozen=True)
class Case:
    """One problem: a random MDP, a random policy and a replay buffer of another policy."""

    seed: int
    successors: int  # of each (s, a): 1 is deterministic, all states make it dense
    discount: float
    divergence: Name
    flow: FlowName = "discounted"
    ends: float = 0.0  # approximate share of steps that end an episode
    concentration: float = 1.0  # of the successors' Dirichlet
    uniform: tuple[float, float] = (0.1, 0.3)  # share in the policy and in the replay's
    states: int = 10
    actions: int = 3
    replay: int = 50_000
    policy_buffer: int = 5_000
    starts: int = 1_000
    same_policy: bool = False  # pi = pi_D

    @property
    def family(self) -> str:
        """The family of the problem, with which the labels of variants begin."""
        if self.ends:
            return f"{self.flow} flow: "
        return "dense MDPs: " if self.successors == self.states else ""

    @property
    def made_by(self) -> FlowName:
        """The occupancy from which samples are drawn: that of the stream if episodes end."""
        return "stationary" if self.ends else "discounted"


@dataclass(frozen=True)
class Variant:
    """A variant of the estimator: a preset of TomConfig with changes, E_{a'} exact or sampled."""

    label: str
    preset: Literal["paper", "exact"] = "exact"
    changes: Mapping[str, Any] = field(default_factory=dict)
    support: bool = False  # the policy gives its probabilities, so that E_{a'} is exact

    def config(self, case: Case) -> TomConfig:
        """The settings for a case."""
        own = {"discount": case.discount, "divergence": case.divergence, "flow": case.flow}
        return TomConfig.preset(self.preset).but(**own | dict(self.changes))


EXACT = "exact, exact expectation over a'"
VARIANTS: tuple[Variant, ...] = (
    Variant(EXACT, support=True),
    Variant("exact, 10 sampled a'"),
    Variant("exact, 1 sampled a'", changes={"action_samples": 1}),
    Variant(
        "exact, a discriminator of (s, a, s')",
        changes={"discriminator_input": "transitions"},
        support=True,
    ),
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
DENSE = Variant(f"dense MDPs: {EXACT}", support=True)
ENDING: dict[FlowName, Variant] = {
    flow: Variant(f"{flow} flow: {EXACT}", support=True)
    for flow in ("stationary", "restart", "discounted")
}
MENDED = Variant("stationary flow: mended", "paper", PRESETS["mended"]["tom"])
ENDING_PAPER = Variant("discounted flow: paper", "paper")


@dataclass(frozen=True)
class Score:
    """The quality of one estimate; every sum runs over the replay buffer's rows."""

    spearman: float  # rank correlation of estimated and exact weights
    l1: float  # sum |w - w*| / sum w*
    flow: float  # L1 residual of the flow constraint under the weighted replay
    log_ratio: float  # correlation of the discriminator's logit and the exact log p/q
    raw_mean: float  # mean weight before normalisation, relative to the exact mean
    ends: float | None  # weight on transitions that end an episode, relative to the exact one


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


def cases(seeds: Iterable[int]) -> list[Case]:
    """Every seed with chi-square and KL, deterministic and stochastic, discount 0.9 and 0.99."""
    return [
        Case(seed, successors, discount, divergence)
        for seed in seeds
        for successors in (1, 3)
        for discount in (0.9, 0.99)
        for divergence in ("chi2", "kl")
    ]


def dense_cases(seeds: Iterable[int]) -> list[Case]:
    """MDPs in which every step may lead to any state: 10 and 20 states, few or many likely ones.

    The two policies are similar or very different.
    """
    return [
        Case(
            seed,
            states,
            0.99,
            divergence,
            states=states,
            concentration=concentration,
            uniform=uniform,
        )
        for seed in seeds
        for states in (10, 20)
        for concentration in (0.2, 5.0)
        for uniform in ((0.1, 0.3), (0.0, 0.05))
        for divergence in ("chi2", "kl")
    ]


def ending_cases(seeds: Iterable[int], flow: FlowName) -> list[Case]:
    """MDPs in which one step in a hundred ends an episode, deterministic to dense.

    There are no cases of a discounted flow under KL, which has zero weight on ends.
    """
    return [
        Case(seed, successors, 0.99, divergence, flow, ends=0.01)
        for seed in seeds
        for successors in (1, 2, 3, 10)
        for divergence in ("chi2", "kl")
        if (flow, divergence) != ("discounted", "kl")
    ]


def draw(case: Case, rng: np.random.Generator) -> tuple[Mdp, Array, Array]:
    """The case's MDP, the policy of interest and the policy of the replay, (S, A) each.

    Most policies take every action from time to time, because no discriminator can learn the log
    ratio of a transition with p = 1e-5 from 5 000 transitions of the policy.
    """
    mdp = random_mdp(
        case.states, case.actions, case.successors, case.discount, rng, case.concentration
    )
    if case.ends:
        mdp = with_endings(mdp, case.ends, rng)
    ours, others = case.uniform
    target = random_policy(mdp, rng, uniform=ours)
    return mdp, target, target if case.same_policy else random_policy(mdp, rng, uniform=others)


def problem_of(case: Case, mdp: Mdp, target: Array, behaviour: Array) -> OccupancyProblem:
    """The exact problem that the case's buffers are samples of."""
    p, q = (transition_occupancy(mdp, policy, case.made_by) for policy in (target, behaviour))
    return OccupancyProblem.of(mdp, target, q, case.flow, p)


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
    share = _on(ends, problem.replay * weights) / _on(ends, problem.replay * ratio)
    return share, mass, float(problem.replay @ np.abs(weights - ratio))


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


Inputs = Literal["transitions", "state-actions"]


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


def summary(rows: Iterable[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """For each variant, in order: number of runs, median and worst value of each measure."""
    by_variant: dict[str, list[Mapping[str, Any]]] = {}
    for row in rows:
        by_variant.setdefault(row["variant"], []).append(row)
    return [{"variant": name, **_summarise(group)} for name, group in by_variant.items()]


def _summarise(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    column = {name: np.array([row[name] for row in rows], float) for name in Score.__annotations__}
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
        **_ends([row["ends"] for row in rows]),
    }


def _ends(ratios: Sequence[float | None]) -> dict[str, float | None]:
    """Median and worst of the weight on ends relative to the exact one, if episodes end."""
    known = np.array([ratio for ratio in ratios if ratio is not None])
    if len(known) == 0:
        return {"ends": None, "ends_worst": None}
    worst = known[np.abs(known - 1).argmax()]
    return {"ends": float(np.median(known)), "ends_worst": float(worst)}


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
        flow=float(np.abs(problem.residual(flow_mass * mass / problem.replay)).sum()),
        log_ratio=_correlation(log_ratio, problem.log_ratio[rows]),
        raw_mean=raw_mean / flow_mass,
        ends=_on(ends, weights) / _on(ends, exact[rows]) if ends.any() else None,
    )
    with np.errstate(invalid="ignore"):
        estimated = mass * len(rows) / count
    return Estimate(case, label, score, problem.replay, exact, estimated)


def _on(chosen: NDArray[np.bool_], weights: Array) -> float:
    """The share of all weight on the chosen rows."""
    return float(weights[chosen].sum() / weights.sum())


def _correlation(x: Array, y: Array) -> float:
    return float(np.corrcoef(x, y)[0, 1])


Rows = Sequence[Mapping[str, Any]]


def acceptance(
    rows: Rows, same_policy: Rows, dense: Rows, stationary: Rows, mended: Rows
) -> list[Check]:
    """The checks of an estimator, over every family that has rows.

    `same_policy` are problems whose replay buffer comes from the policy itself, `dense` those of
    `dense_cases`, `stationary` and `mended` those of `ending_cases` with these two variants.
    """
    checks = near_exact("", rows)
    if same_policy:
        same = max(row["l1"] for row in same_policy)
        checks.append(at_most("pi = pi_D: relative L1 distance from 1, worst", same, 0.12))
    checks += near_exact("dense: ", dense) + near_exact("stationary: ", stationary)
    for name, group in (("stationary", stationary), ("mended", mended)):
        if group:
            off = abs(float(np.median([row["ends"] for row in group])) - 1)
            checks.append(at_most(f"{name}: weight on ends off the exact, median", off, 0.20))
    return checks


def near_exact(family: str, rows: Rows) -> list[Check]:
    """The checks of one family of problems; none if it has no rows."""
    if not rows:
        return []
    s = _summarise(rows)
    off = max(abs(row["raw_mean"] - 1) for row in rows)
    return [
        at_least(f"{family}rank correlation of the weights, median", s["spearman"], 0.95),
        at_least(f"{family}rank correlation of the weights, worst", s["spearman_worst"], 0.90),
        at_most(f"{family}relative L1 error, median", s["l1"], 0.12),
        at_most(f"{family}relative L1 error, worst", s["l1_worst"], 0.20),
        at_most(f"{family}flow residual, worst", s["flow_worst"], 0.12),
        at_least(f"{family}logit against log ratio, worst", s["log_ratio_worst"], 0.95),
        at_most(f"{family}mean weight off the exact, worst", off, 0.05),
    ]
