"""Small MDPs: random ones, their occupancies, and samples of them as a learner sees them.

A flow (`tom/learners/terms.py`) defines what follows the end of an episode, and with it an
occupancy: discounted visits until the end, discounted visits with a new start after every end, or
the stream of transitions as it is collected, resets included.

A learner sees states and actions as one-hot vectors.
"""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
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
    into = np.einsum("ij,kli->ijkl", policy, _following(mdp, flow))  # (i, j) out of (k, l)
    step = into.reshape(policy.size, policy.size)
    if flow == "stationary":
        return _stationary(step).reshape(policy.shape)
    start = (1 - mdp.discount) * mdp.start[:, None] * policy
    system = np.eye(policy.size) - mdp.discount * step
    return np.linalg.solve(system, start.ravel()).reshape(policy.shape)


def transition_occupancy(mdp: Mdp, policy: Array, flow: FlowName = "discounted") -> Array:
    """d^pi(s, a, s') (S, A, S) = T(s'|s, a) d^pi(s, a) (paper, eq. 8)."""
    return occupancy(mdp, policy, flow)[:, :, None] * mdp.transition


def _following(mdp: Mdp, flow: FlowName) -> Array:
    """The distribution of the next state, (S, A, S); after an end zero, or that of a new start."""
    alive = mdp.transition * ~mdp.terminal
    if flow == "discounted":
        return alive
    ends = (mdp.transition * mdp.terminal).sum(2, keepdims=True)
    return alive + ends * mdp.start


def _stationary(step: Array) -> Array:
    """The distribution d (N,) with d = step d, the columns of `step` (N, N) summing to 1."""
    system = np.eye(len(step)) - step
    system[0] = 1.0  # the rows sum to zero, so one of them can be replaced by the mass constraint
    if np.linalg.matrix_rank(system) < len(step):
        raise ArithmeticError("the stream has no distribution of its own: no episode ends")
    return np.linalg.solve(system, np.eye(len(step))[0]).clip(min=0.0)


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
    starts, actions, moves = (_ladder(p) for p in (mdp.start, policy, mdp.transition))
    index = np.empty((n, 3), np.intp)
    s = starts.searchsorted(rng.random(), "right")
    for row, (u, v, w) in zip(index, rng.random((n, 3)), strict=True):
        a = actions[s].searchsorted(u, "right")
        s_next = moves[s, a].searchsorted(v, "right")
        row[:] = s, a, s_next
        s = starts.searchsorted(w, "right") if mdp.terminal[s_next] else s_next
    return _one_hot(mdp, index), index


def _ladder(p: Array) -> Array:
    """Cumulative probabilities over the last axis; the last one is exactly 1."""
    total = p.cumsum(-1)
    return total / total[..., -1:]


def _one_hot(mdp: Mdp, index: NDArray[np.intp]) -> Transitions:
    s, a, s_next = index.T
    state, action = np.eye(mdp.states, dtype=np.float32), np.eye(mdp.actions, dtype=np.float32)
    zeros = np.zeros(len(index), np.float32)
    terminated = mdp.terminal[s_next].astype(np.float32)
    return Transitions(state[s], action[a], zeros, state[s_next], terminated, zeros)


def sample_starts(mdp: Mdp, n: int, rng: np.random.Generator) -> NDArray[np.float32]:
    """n one-hot draws of the start distribution, (n, S)."""
    return np.eye(mdp.states, dtype=np.float32)[rng.choice(mdp.states, size=n, p=mdp.start)]
