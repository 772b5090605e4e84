"""TOM's weights of a small MDP to machine precision.

`occupancy_weights` estimates weights from samples; here they follow from a linear solve and a
convex programme in S A variables.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.special import logsumexp, xlogy

from tom.analysis.tabular import Array, FlowName, Mdp, transition_occupancy

Name = Literal["chi2", "kl"]
MAX_NEWTON_STEPS = 200
CONVERGED = 1e-11  # flow residual at which Newton's method stops
EXACT = 1e-8  # largest relative duality gap, and flow residual, of an exact solution


@dataclass(frozen=True)
class OccupancyProblem:
    """TOM's primal (paper, eq. 15) and dual (eq. 16) over the R transitions in the replay buffer.

    `flow` (R, S A) is the operator of the dual: y = r + flow Q with
    (flow Q)(s, a, s') = g E_{a'~pi}[Q(s', a')] - Q(s, a); `inflow` (S A) = (1-g) mu0(s) pi(a|s).
    After an end, Q(s', a') is replaced by E_{mu0,pi}[Q] if the flow restarts, else by 0. A
    stationary flow has g = 1 and one more dual variable, the last: the multiplier lambda of the
    mass constraint, whose column is -1 and whose inflow is 1.
    """

    index: tuple[NDArray[np.intp], ...]  # s, a and s' of each, (R,)
    replay: Array  # q (R,)
    log_ratio: Array  # r = log p/q (R,)
    flow: Array
    inflow: Array

    @staticmethod
    def of(
        mdp: Mdp,
        policy: Array,
        replay: Array,
        flow: FlowName = "discounted",
        made: Array | None = None,
    ) -> OccupancyProblem:
        """The problem of `policy` against the replay distribution q (S, A, S).

        `made` (S, A, S) is the distribution p of the policy's own samples, for r = log p/q; the
        default is the flow's occupancy (its mass is below 1 if discounted episodes end).
        """
        index = np.nonzero(replay)
        q = replay[index] / replay.sum()
        p = transition_occupancy(mdp, policy, flow) if made is None else made / made.sum()
        with np.errstate(divide="ignore"):  # r = -inf for a transition that the policy never makes
            log_ratio = np.log(p[index] / q)
        operator, inflow = _constraint(mdp, policy, index, flow)
        return OccupancyProblem(index, q, log_ratio, operator, inflow)

    def residual(self, weights: Array) -> Array:
        """The residual of the flow constraint at q w, (S A); stationary: last that of the mass."""
        return self.inflow + self.flow.T @ (self.replay * weights)


def _constraint(
    mdp: Mdp, policy: Array, index: tuple[NDArray[np.intp], ...], flow: FlowName
) -> tuple[Array, Array]:
    """`flow` and `inflow` of an `OccupancyProblem` over the transitions at `index`."""
    s, a, s_next = index
    rows, discount = np.arange(len(s)), 1.0 if flow == "stationary" else mdp.discount
    start = mdp.start[:, None] * policy
    operator = np.zeros((len(s), *policy.shape))
    operator[rows, s_next] = discount * (policy * ~mdp.terminal[:, None])[s_next]
    if flow != "discounted":
        operator[mdp.terminal[s_next]] += discount * start
    operator[rows, s, a] -= 1
    operator = operator.reshape(len(s), -1)
    if flow != "stationary":
        return operator, (1 - discount) * start.ravel()
    return np.column_stack((operator, -np.ones(len(s)))), np.eye(policy.size + 1)[-1]


@dataclass(frozen=True)
class Solution:
    """Optimal weights (R,) and dual Q (S A; lambda last if stationary), and both values."""

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
    """(1-g) E[Q(s0, a0)] + E_q[f*(y)], or + log E_q[exp y] for KL, which the dual minimises.

    Under a stationary flow the first term is lambda, the last of `q`.
    """
    return float(problem.inflow @ q + _dual_terms(problem, q, name)[0])


def solve(problem: OccupancyProblem, name: Name) -> Solution:
    """Minimise the dual by Newton's method with a line search.

    The dual is convex: piecewise quadratic under chi-square, smooth under KL. The weights are the
    primal optimum when they are feasible and both values agree, which is checked.

    Raises ArithmeticError if they do not: the replay then does not cover the policy.
    """
    q = np.zeros(len(problem.inflow))
    curvature = problem.flow.T @ (problem.replay[:, None] * problem.flow)
    for _ in range(MAX_NEWTON_STEPS):
        _, weights, hessian = _dual_terms(problem, q, name)
        gradient = problem.residual(weights)
        if np.abs(gradient).sum() < CONVERGED:
            break
        # Rows of weight zero have no curvature: add a little, which shrinks with convergence.
        damped = hessian + min(1e-2, float(np.abs(gradient).sum())) * curvature
        step = -np.asarray(np.linalg.lstsq(damped, gradient, rcond=1e-14)[0], np.float64)
        q = q + _line_search(problem, q, step, float(gradient @ step), name) * step
    weights = _dual_terms(problem, q, name)[1]
    solution = Solution(
        weights, q, primal_value(problem, weights, name), dual_value(problem, q, name)
    )
    gap = abs(solution.dual - solution.primal) / max(1.0, abs(solution.dual))
    if not (gap < EXACT and np.abs(problem.residual(weights)).sum() < EXACT):
        raise ArithmeticError(f"no dual optimum (gap {gap:.1e}): does the replay cover the policy?")
    return solution


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
