"""Small MDPs whose occupancies and TOM weights are known to machine precision.

What `occupancy_weights` estimates from samples is here a linear solve and a convex programme in
S A variables. States and actions are one-hot vectors to a learner.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.special import logsumexp, xlogy
from torch import Tensor

from tom.data.transitions import Transitions

Array = NDArray[np.float64]
MAX_NEWTON_STEPS = 200
GAP = 1e-11  # duality gap and flow residual at which a solution is exact


@dataclass(frozen=True)
class Mdp:
    """S states, A actions, no reward (none is needed). Entering a `terminal` state ends a path."""

    transition: Array  # (S, A, S)
    start: Array  # (S,)
    discount: float
    terminal: NDArray[np.bool_]  # (S,)

    @property
    def states(self) -> int:
        return self.transition.shape[0]

    @property
    def actions(self) -> int:
        return self.transition.shape[1]


def random_mdp(
    states: int, actions: int, successors: int, discount: float, rng: np.random.Generator
) -> Mdp:
    """Each (s, a) leads to `successors` random states; one makes the MDP deterministic."""
    transition = np.zeros((states, actions, states))
    for row in transition.reshape(-1, states):
        row[rng.choice(states, successors, replace=False)] = rng.dirichlet(np.ones(successors))
    start = rng.dirichlet(np.ones(states))
    return Mdp(transition, start, discount, np.zeros(states, bool))


def random_policy(mdp: Mdp, rng: np.random.Generator, uniform: float = 0.0) -> Array:
    """pi(a|s) (S, A): uniform draws from the simplex, mixed with a share of the uniform policy."""
    drawn = rng.dirichlet(np.ones(mdp.actions), size=mdp.states)
    return (1 - uniform) * drawn + uniform / mdp.actions


def occupancy(mdp: Mdp, policy: Array) -> Array:
    """d^pi(s, a) (S, A), the solution of the Bellman flow constraint (paper, eq. 4)."""
    alive = mdp.transition * ~mdp.terminal  # (S, A, S')
    flow = np.einsum("ij,kli->ijkl", policy, alive)  # into (i, j) out of (k, l)
    size = policy.size
    system = np.eye(size) - mdp.discount * flow.reshape(size, size)
    start = (1 - mdp.discount) * mdp.start[:, None] * policy
    return np.linalg.solve(system, start.ravel()).reshape(policy.shape)


def transition_occupancy(mdp: Mdp, policy: Array) -> Array:
    """d^pi(s, a, s') (S, A, S) = T(s'|s, a) d^pi(s, a) (paper, eq. 8)."""
    return occupancy(mdp, policy)[:, :, None] * mdp.transition


@dataclass(frozen=True)
class OccupancyProblem:
    """TOM's primal (paper, eq. 15) and dual (eq. 16) over the R transitions the replay holds.

    `flow` (R, S A) is the operator of the dual: y = r + flow Q with
    (flow Q)(s, a, s') = g E_{a'~pi}[Q(s', a')] - Q(s, a); `inflow` (S A) = (1-g) mu0(s) pi(a|s).
    """

    index: tuple[NDArray[np.intp], ...]  # s, a and s' of each, (R,)
    replay: Array  # q (R,)
    log_ratio: Array  # r = log p/q (R,)
    flow: Array
    inflow: Array

    @staticmethod
    def of(mdp: Mdp, policy: Array, replay: Array) -> OccupancyProblem:
        """The problem of `policy` against the replay distribution q (S, A, S)."""
        index = np.nonzero(replay)
        s, a, s_next = index
        q = replay[index]
        rows = np.arange(len(q))
        flow = np.zeros((len(q), *policy.shape))
        flow[rows, s_next] = mdp.discount * (policy * ~mdp.terminal[:, None])[s_next]
        flow[rows, s, a] -= 1
        inflow = (1 - mdp.discount) * mdp.start[:, None] * policy
        with np.errstate(divide="ignore"):  # a transition the policy never makes: r = -inf
            log_ratio = np.log(transition_occupancy(mdp, policy)[index] / q)
        return OccupancyProblem(index, q, log_ratio, flow.reshape(len(q), -1), inflow.ravel())

    def residual(self, weights: Array) -> Array:
        """How far q w is from satisfying the Bellman transition flow constraint, (S A)."""
        return self.inflow + self.flow.T @ (self.replay * weights)

    def fitted_model(self, weights: Array, mdp: Mdp) -> Array:
        """The transition function that weighted maximum likelihood fits (eqs. 9, 18), (S, A, S).

        NaN where the weights leave a state and action without mass.
        """
        mass = np.zeros_like(mdp.transition)
        mass[self.index] = self.replay * weights
        with np.errstate(invalid="ignore"):
            return mass / mass.sum(2, keepdims=True)


Name = Literal["chi2", "kl"]


@dataclass(frozen=True)
class Solution:
    """Optimal weights (R,) and dual Q (S A), with both problems' values there."""

    weights: Array
    q: Array
    primal: float
    dual: float


def primal_value(problem: OccupancyProblem, weights: Array, name: Name) -> float:
    """E_{q w}[r] - D_f(q w || q), which the primal maximises."""
    f = (weights - 1) ** 2 / 2 if name == "chi2" else xlogy(weights, weights)
    gain = weights * np.where(weights > 0, problem.log_ratio, 0.0)
    return float(problem.replay @ (gain - f))


def dual_value(problem: OccupancyProblem, q: Array, name: Name) -> float:
    """(1-g) E[Q(s0, a0)] + E_q[f*(y)], or + log E_q[exp y] for KL, which the dual minimises."""
    return float(problem.inflow @ q + _dual_terms(problem, q, name)[0])


def solve(problem: OccupancyProblem, name: Name) -> Solution:
    """Minimise the dual by Newton's method with a line search.

    The dual is convex: piecewise quadratic under chi-square, smooth under KL. The weights are the
    primal optimum when they are feasible and both values agree, which is checked.

    Raises ArithmeticError where that is not reached: the replay then does not cover the policy.
    """
    q = np.zeros(len(problem.inflow))
    curvature = problem.flow.T @ (problem.replay[:, None] * problem.flow)
    for _ in range(MAX_NEWTON_STEPS):
        _, weights, hessian = _dual_terms(problem, q, name)
        gradient = problem.residual(weights)
        if np.abs(gradient).sum() < GAP:
            break
        # Rows of weight zero have no curvature: lend them a little, ever less as we converge.
        damped = hessian + min(1e-2, float(np.abs(gradient).sum())) * curvature
        step = -np.asarray(np.linalg.lstsq(damped, gradient, rcond=1e-14)[0], np.float64)
        q = q + _line_search(problem, q, step, float(gradient @ step), name) * step
    weights = _dual_terms(problem, q, name)[1]
    found = Solution(weights, q, primal_value(problem, weights, name), dual_value(problem, q, name))
    gap = abs(found.dual - found.primal) / max(1.0, abs(found.dual))
    if not (gap < 1e-8 and np.abs(problem.residual(weights)).sum() < 1e-8):
        raise ArithmeticError(f"no dual optimum (gap {gap:.1e}): does the replay cover the policy?")
    return found


def _dual_terms(problem: OccupancyProblem, q: Array, name: Name) -> tuple[float, Array, Array]:
    """The dual's term in f*, the weights f*'(y) and the Hessian, at Q."""
    y = problem.log_ratio + problem.flow @ q
    if name == "chi2":
        weights = np.maximum(0.0, 1 + y)
        active = problem.replay * (weights > 0)
        hessian = problem.flow.T @ (active[:, None] * problem.flow)
        return float(problem.replay @ (weights**2 - 1) / 2), weights, hessian
    value = float(logsumexp(y, b=problem.replay))
    weights = np.exp(y - value)
    mass = problem.replay * weights
    mean = mass @ problem.flow
    hessian = problem.flow.T @ (mass[:, None] * problem.flow) - np.outer(mean, mean)
    return value, weights, hessian


def _line_search(
    problem: OccupancyProblem, q: Array, step: Array, slope: float, name: Name
) -> float:
    """The largest of 1, 1/2, 1/4, ... that lowers the dual enough (Armijo), or 1 at rounding."""
    here, size = dual_value(problem, q, name), 1.0
    while size > 1e-6:
        if dual_value(problem, q + size * step, name) <= here + 1e-4 * size * slope:
            return size
        size /= 2
    return 1.0


@dataclass(frozen=True)
class OneHotPolicy:
    """A tabular policy (S, A) as a learner meets it: one-hot observations and actions."""

    probs: Tensor  # (S, A)

    def support(self, obs: Tensor) -> tuple[Tensor, Tensor]:
        """Every action, (A, B, A), and its probability, (A, B)."""
        actions = torch.eye(self.probs.shape[1]).unsqueeze(1).expand(-1, len(obs), -1)
        return actions, self.probs[obs.argmax(1)].T

    def __call__(self, obs: Tensor, n: int, generator: torch.Generator) -> Tensor:
        """n draws for each observation, (n, B, A)."""
        drawn = torch.multinomial(self.probs[obs.argmax(1)], n, True, generator=generator)
        return torch.eye(self.probs.shape[1])[drawn.T]


def sample_transitions(
    mdp: Mdp, distribution: Array, n: int, rng: np.random.Generator
) -> tuple[Transitions, NDArray[np.intp]]:
    """n draws of (s, a, s') (S, A, S) with one-hot features, and the three indices, (n, 3)."""
    p = distribution.ravel() / distribution.sum()
    flat = rng.choice(len(p), size=n, p=p)
    s, a, s_next = np.unravel_index(flat, distribution.shape)
    state, action = np.eye(mdp.states, dtype=np.float32), np.eye(mdp.actions, dtype=np.float32)
    zeros = np.zeros(n, np.float32)
    terminated = mdp.terminal[s_next].astype(np.float32)
    rows = Transitions(state[s], action[a], zeros, state[s_next], terminated, zeros)
    return rows, np.stack((s, a, s_next), axis=1)


def sample_starts(mdp: Mdp, n: int, rng: np.random.Generator) -> NDArray[np.float32]:
    """n one-hot draws of the start distribution, (n, S)."""
    return np.eye(mdp.states, dtype=np.float32)[rng.choice(mdp.states, size=n, p=mdp.start)]
