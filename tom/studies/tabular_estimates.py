"""TOM's estimated weights against exact ones on a small MDP: draw buffers, estimate, compare.

If no episode ends, both buffers are draws from discounted occupancies, as the theory requires. If
episodes end, both are streams in order, as in training, for every flow.
"""

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.stats import rankdata

from tom.config import TomConfig
from tom.data.transitions import Transitions
from tom.learners.tom import occupancy_weights
from tom.studies.mdp import (
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
from tom.studies.study import Row
from tom.training.presets import PRESETS

Inputs = Literal["transitions", "state-actions"]
"""of the discriminator (`TomConfig.discriminator_input`)"""
Index = NDArray[np.intp]
"""s, a and s' of each row, (N, 3)"""


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
        Case(seed, n, 0.99, divergence, states=n, concentration=concentration, uniform=uniform)
        for seed in seeds
        for n in (10, 20)
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


@dataclass(frozen=True)
class Variant:
    """A variant of the estimator: a preset of TomConfig with changes, E_{a'} exact or sampled.

    Some do what theory forbids. One of `counts` trains nothing: its weights are the exact ones with
    r from counts of these inputs. That is the sampling error, which no estimate of r can improve by
    much.
    """

    label: str
    preset: Literal["paper", "exact"] = "exact"
    changes: Mapping[str, Any] = field(default_factory=dict)
    support: bool = False  # the policy gives its probabilities, so that E_{a'} is exact
    counts: Inputs | None = None

    def config(self, case: Case) -> TomConfig:
        """The settings for a case."""
        own = {"discount": case.discount, "divergence": case.divergence, "flow": case.flow}
        return TomConfig.preset(self.preset).but(**own | dict(self.changes))


EXACT = "exact, exact expectation over a'"
PAPER = "paper, 1 sampled a'"
"""the variant with the paper's networks and steps"""
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
    Variant(PAPER, preset="paper"),
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


def counts_of(case: Case, inputs: Inputs) -> Variant:
    read = "(s, a)" if inputs == "state-actions" else "(s, a, s')"
    return Variant(f"{case.family}counts of {read}", counts=inputs)


@dataclass(frozen=True)
class Estimate:
    """The row of case, variant and score, with its points: the R distinct transitions of the MDP.

    The score, over the replay buffer's rows: `spearman` is the rank correlation of estimated and
    exact weights, `l1` is sum |w - w*| / sum w*, `flow_residual` the L1 residual of the flow
    constraint under the weighted replay, `log_ratio` the correlation of the discriminator's logit
    and the exact log p/q, `raw_mean` the mean weight before normalisation over the exact mean,
    `ends_ratio` the weight on transitions that end an episode over the exact one, None without any.
    """

    row: Row
    replay: Array  # q (R,)
    exact: Array  # exact weights (R,)
    estimated: Array  # mean estimated weight of each transition (R,); NaN if it was not drawn


def estimate(task: tuple[Case, Variant]) -> Estimate:
    """Draw the case's buffers, estimate their weights and compare them with the exact ones."""
    case, variant = task
    rng = np.random.default_rng(case.seed)
    mdp, target, behaviour = draw(case, rng)

    def sample(policy: Array, n: int) -> tuple[Transitions, Index]:
        if case.ends:
            return sample_stream(mdp, policy, n, rng)
        return sample_transitions(mdp, transition_occupancy(mdp, policy), n, rng)

    buffer, index = sample(behaviour, case.replay)
    policy_rows, recent = sample(target, case.policy_buffer)
    starts = sample_starts(mdp, case.starts, rng)
    problem = problem_of(case, mdp, target, behaviour)
    if variant.counts:
        weights, ratio, mean = _counted(problem, index, recent, mdp, case, variant.counts)
    else:
        policy = OneHotPolicy(torch.from_numpy(target).float())
        found = occupancy_weights(
            buffer,
            policy_rows,
            # A bound method has no `support`, so that the policy can only be sampled.
            policy if variant.support else policy.__call__,
            torch.from_numpy(starts),
            variant.config(case),
            torch.Generator().manual_seed(case.seed),
        )
        weights, ratio = (np.asarray(x, np.float64) for x in (found.weights, found.log_ratio))
        mean = found.metrics["weights/raw_mean"]
    exact = solve(problem, case.divergence).weights
    flow_mass = float(problem.replay @ exact)  # below 1 if the flow loses mass at ends
    exact = exact / flow_mass
    lookup = np.full(mdp.transition.shape, -1, np.intp)
    lookup[problem.index] = np.arange(len(problem.replay))
    rows = lookup[tuple(index.T)]  # of each buffer row among the R transitions, (N,)
    mass = np.bincount(rows, weights, minlength=len(exact)) / len(rows)  # of the weighted replay
    ends = mdp.terminal[index[:, 2]]
    score = {
        "spearman": _correlation(rankdata(weights), rankdata(exact[rows])),
        "l1": float(np.abs(weights - exact[rows]).sum() / exact[rows].sum()),
        "flow_residual": float(np.abs(problem.residual(flow_mass * mass / problem.replay)).sum()),
        "log_ratio": _correlation(ratio, problem.log_ratio[rows]),
        "raw_mean": mean / flow_mass,
        "ends_ratio": share_on(ends, weights) / share_on(ends, exact[rows]) if ends.any() else None,
    }
    with np.errstate(invalid="ignore"):
        estimated = mass * len(rows) / np.bincount(rows, minlength=len(exact))
    row = {**asdict(case), "variant": variant.label, **score}
    return Estimate(row, problem.replay, exact, estimated)


def _counted(
    problem: OccupancyProblem, index: Index, recent: Index, mdp: Mdp, case: Case, inputs: Inputs
) -> tuple[Array, Array, float]:
    """Weights and log ratio of each row of the buffer, from counts, and their mean before."""
    rows = tuple(index.T)
    q, p = (np.zeros(mdp.transition.shape) for _ in range(2))
    np.add.at(q, rows, 1)
    np.add.at(p, tuple(recent.T), 1)
    if inputs == "state-actions":
        q, p = (np.broadcast_to(x.sum(2, keepdims=True), x.shape) for x in (q, p))
    # Add half a transition to the policy's counts and the corresponding number to the replay's, so
    # that r is finite, and zero for transitions in neither buffer.
    ratio = np.log((p + 0.5) / (q * (len(recent) / len(index)) + 0.5))
    weights = np.zeros(q.shape)
    noisy = replace(problem, log_ratio=ratio[problem.index])
    weights[problem.index] = solve(noisy, case.divergence).weights
    mean = float(weights[rows].mean())
    return weights[rows] / mean, ratio[rows], mean


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
    """The exact problem that the case's buffers are samples of: streams if episodes end."""
    made_by: FlowName = "stationary" if case.ends else "discounted"
    p, q = (transition_occupancy(mdp, policy, made_by) for policy in (target, behaviour))
    return OccupancyProblem.of(mdp, target, q, case.flow, p)


def share_on(chosen: NDArray[np.bool_], weights: Array) -> float:
    """The share of all weight on the chosen rows."""
    return float(weights[chosen].sum() / weights.sum())


def _correlation(x: Array, y: Array) -> float:
    return float(np.corrcoef(x, y)[0, 1])
