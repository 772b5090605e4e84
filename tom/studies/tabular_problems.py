"""The problems of the tabular study: small random MDPs and the policies on them."""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tom.analysis.exact_weights import Name, OccupancyProblem
from tom.analysis.tabular import (
    Array,
    FlowName,
    Mdp,
    random_mdp,
    random_policy,
    transition_occupancy,
    with_endings,
)


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


def share_on(chosen: NDArray[np.bool_], weights: Array) -> float:
    """The share of all weight on the chosen rows."""
    return float(weights[chosen].sum() / weights.sum())
