"""Small MDPs: random ones, their occupancies, samples of them, and TOM's exact weights.

A flow (`tom/learners/terms.py`) defines what follows the end of an episode, and with it an
occupancy: discounted visits until the end, discounted visits with a new start after every end, or
the stream of transitions as it is collected, resets included. A learner sees states and actions as
one-hot vectors.

`occupancy_weights` estimates weights from samples; here they follow to machine precision from a
linear solve and a convex programme in S A variables.
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
FlowName = Literal["discounted", "restart", "stationary"]


@dataclass(frozen=True)
class Mdp:
    """S states, A actions, no reward. Entering a `terminal` state ends an episode."""

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
    states: int,
    actions: int,
    successors: int,
    discount: float,
    rng: np.random.Generator,
    concentration: float = 1.0,
) -> Mdp:
    """Each (s, a) leads to `successors` random states; 1 makes the MDP deterministic.

    Their probabilities are a Dirichlet draw: a small concentration makes few of them matter.
    """
    transition, alpha = np.zeros((states, actions, states)), np.full(successors, concentration)
    for row in transition.reshape(-1, states):
        row[rng.choice(states, successors, replace=False)] = rng.dirichlet(alpha)
    start = rng.dirichlet(np.ones(states))
    return Mdp(transition, start, discount, np.zeros(states, bool))


def with_endings(mdp: Mdp, share: float, rng: np.random.Generator) -> Mdp:
    """The same MDP with one more state, the last, that ends an episode; no episode starts there.

    The probability that (s, a) leads to it is an exponential draw of mean `share`, so that about
    this share of all steps ends, at some (s, a) more often than at others.
    """
    ends = np.minimum(share * rng.exponential(size=(mdp.states, mdp.actions, 1)), 1.0)
    end = np.eye(mdp.states + 1)[-1]
    transition = np.tile(end, (mdp.states + 1, mdp.actions, 1))
    transition[:-1] = np.concatenate(((1 - ends) * mdp.transition, ends), axis=2)
    return Mdp(transition, np.append(mdp.start, 0.0), mdp.discount, end > 0)


def random_policy(mdp: Mdp, rng: np.random.Generator, uniform: float = 0.0) -> Array:
    """pi(a|s) (S, A): uniform draws from the simplex, mixed with a share of the uniform policy."""
    drawn = rng.dirichlet(np.ones(mdp.actions), size=mdp.states)
    return (1 - uniform) * drawn + uniform / mdp.actions


def occupancy(mdp: Mdp, policy: Array, flow: FlowName = "discounted") -> Array:
    """d^pi(s, a) (S, A), the solution of a flow constraint (discounted: paper, eq. 4).

    `stationary` is the stream as it is collected: no discount, mass 1. Raises ArithmeticError if
    the stationary distribution is not unique (several closed sets of states and no end).
    """
    following = mdp.transition * ~mdp.terminal  # the next state's distribution, (S, A, S)
    if flow != "discounted":  # after an end, that of a new start
        following += (mdp.transition * mdp.terminal).sum(2, keepdims=True) * mdp.start
    step = np.einsum("ij,kli->ijkl", policy, following).reshape(policy.size, policy.size)
    if flow != "stationary":
        start = (1 - mdp.discount) * mdp.start[:, None] * policy
        system = np.eye(policy.size) - mdp.discount * step  # (i, j) out of (k, l)
        return np.linalg.solve(system, start.ravel()).reshape(policy.shape)
    system = np.eye(len(step)) - step
    system[0] = 1.0  # the rows sum to zero, so one of them can be replaced by the mass constraint
    if np.linalg.matrix_rank(system) < len(step):
        raise ArithmeticError("the stream has no distribution of its own: no episode ends")
    return np.linalg.solve(system, np.eye(len(step))[0]).clip(min=0.0).reshape(policy.shape)


def transition_occupancy(mdp: Mdp, policy: Array, flow: FlowName = "discounted") -> Array:
    """d^pi(s, a, s') (S, A, S) = T(s'|s, a) d^pi(s, a) (paper, eq. 8)."""
    return occupancy(mdp, policy, flow)[:, :, None] * mdp.transition


@dataclass(frozen=True)
class OneHotPolicy:
    """A tabular policy (S, A) as a learner sees it: one-hot observations and actions."""

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
    index = np.stack(np.unravel_index(flat, distribution.shape), axis=1)
    return _one_hot(mdp, index), index


def sample_stream(
    mdp: Mdp, policy: Array, n: int, rng: np.random.Generator
) -> tuple[Transitions, NDArray[np.intp]]:
    """n steps of the policy in order, a new start after every end, as `sample_transitions`."""
    sums = (p.cumsum(-1) for p in (mdp.start, policy, mdp.transition))
    starts, actions, moves = (p / p[..., -1:] for p in sums)  # the last one is exactly 1
    index = np.empty((n, 3), np.intp)
    s = starts.searchsorted(rng.random(), "right")
    for row, (u, v, w) in zip(index, rng.random((n, 3)), strict=True):
        a = actions[s].searchsorted(u, "right")
        s_next = moves[s, a].searchsorted(v, "right")
        row[:] = s, a, s_next
        s = starts.searchsorted(w, "right") if mdp.terminal[s_next] else s_next
    return _one_hot(mdp, index), index


def _one_hot(mdp: Mdp, index: NDArray[np.intp]) -> Transitions:
    s, a, s_next = index.T
    state, action = np.eye(mdp.states, dtype=np.float32), np.eye(mdp.actions, dtype=np.float32)
    zeros = np.zeros(len(index), np.float32)
    terminated = mdp.terminal[s_next].astype(np.float32)
    return Transitions(state[s], action[a], zeros, state[s_next], terminated, zeros)


def sample_starts(mdp: Mdp, n: int, rng: np.random.Generator) -> NDArray[np.float32]:
    """n one-hot draws of the start distribution, (n, S)."""
    return np.eye(mdp.states, dtype=np.float32)[rng.choice(mdp.states, size=n, p=mdp.start)]


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
        s, a, s_next = index
        rows, discount = np.arange(len(s)), 1.0 if flow == "stationary" else mdp.discount
        start = mdp.start[:, None] * policy
        operator = np.zeros((len(s), *policy.shape))
        operator[rows, s_next] = discount * (policy * ~mdp.terminal[:, None])[s_next]
        if flow != "discounted":
            operator[mdp.terminal[s_next]] += discount * start
        operator[rows, s, a] -= 1
        operator, inflow = operator.reshape(len(s), -1), (1 - discount) * start.ravel()
        if flow == "stationary":
            operator = np.column_stack((operator, -np.ones(len(s))))
            inflow = np.eye(policy.size + 1)[-1]
        return OccupancyProblem(index, q, log_ratio, operator, inflow)

    def residual(self, weights: Array) -> Array:
        """The residual of the flow constraint at q w, (S A); stationary: last that of the mass."""
        return self.inflow + self.flow.T @ (self.replay * weights)


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
