"""Ways of weighing that train no network, with their exact weights on small MDPs.

The replay is the mixture of an exploring policy's stream and those of policies that drift to the
policy of interest; a row is (k, s, a, s'), k the policy that collected it. What a learner estimates
is given here: all distances are those of the policies, and PMER's error is that of the true model's
mean, which a model fitted to this replay would reach.
"""

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
import torch
from scipy.special import rel_entr

from tom.config import ActionRatioConfig, PdmlConfig, PmerConfig, PolicyDistanceConfig
from tom.learners.action_ratio import ratio_weights
from tom.learners.pdml import policy_weights, total_variation
from tom.learners.pmac import recency_probabilities
from tom.learners.policy_distance import distance_weights
from tom.studies.mdp import Array, Mdp, transition_occupancy
from tom.studies.study import Row
from tom.studies.tabular_estimates import draw, ending_cases

POLICIES = 8
"""that drift, evenly, from the replay's policy to that of interest, which is not among them"""
DECAY = 0.7
"""of recency: its memory is three policies"""
OVER_BUFFER = "pdml, over the buffer's states"
"""as published; the learner averages over each policy's own states, which is all that rows hold"""


@dataclass(frozen=True)
class History:
    """A replay and the policy of interest; exploration comes first of the K policies."""

    mdp: Mdp
    target: Array  # (S, A)
    policies: Array  # (K, S, A)

    @property
    def mass(self) -> Array:
        """The share of each row of the replay, (K, S, A, S), all policies alike."""
        of_each = [transition_occupancy(self.mdp, each, "stationary") for each in self.policies]
        return np.stack(of_each) / len(of_each)


def history(mdp: Mdp, target: Array, behaviour: Array) -> History:
    """The history of a case: uniform exploration, then `POLICIES` from behaviour to target."""
    drift = np.arange(POLICIES)[:, None, None] / POLICIES
    drifting = (1 - drift) * behaviour + drift * target
    uniform = np.full((1, *target.shape), 1 / mdp.actions)
    return History(mdp, target, np.concatenate((uniform, drifting)))


def weights_of(past: History) -> dict[str, Array]:
    """The weights of every way at each row, (K, S, A, S) by broadcasting, of any mean."""
    mdp, explored, mass = past.mdp, np.zeros((1, past.mdp.states)), past.mass
    # KL(pi(.|s) || pi_k(.|s)) of each policy that is no exploration, (K - 1, S).
    divergence = torch.from_numpy(rel_entr(past.target, past.policies[1:]).sum(2))
    near = distance_weights(divergence, PolicyDistanceConfig().floor).numpy()
    log_ratio = torch.from_numpy(np.log(past.target) - np.log(past.policies))[..., None]
    error = np.sqrt(np.square(np.eye(mdp.states) - mdp.transition[..., None, :]).mean(-1))
    pmer = PmerConfig()
    by_error = error**pmer.sharpness
    bound, states = total_variation(divergence).numpy(), mass.sum((2, 3))  # (K, S)

    def of_policies(states: Array) -> Array:
        """PDML's weights (K, 1, 1, 1), each policy's distance a mean over `states` (K - 1, S)."""
        distance = np.average(bound, axis=1, weights=states)[::-1].copy()  # the newest first
        each, exploration = policy_weights(
            torch.from_numpy(distance), torch.ones(len(distance)), PdmlConfig()
        )
        return np.append(float(exploration), each.numpy()[::-1]).reshape(-1, 1, 1, 1)

    each = torch.arange(len(past.policies))
    return {
        "uniform": np.ones((1, 1, 1, 1)),
        "recency": recency_probabilities(each, DECAY).numpy().reshape(-1, 1, 1, 1),
        "pdml": of_policies(states[1:]),
        OVER_BUFFER: of_policies(np.broadcast_to(states.sum(0), states[1:].shape)),
        "policy-distance": np.concatenate((explored, near)).reshape(-1, mdp.states, 1, 1),
        "action-ratio": ratio_weights(log_ratio, ActionRatioConfig().clip).numpy(),
        "pmer": (1 - pmer.share + pmer.share * by_error / (mass.sum(0) * by_error).sum())[None],
    }


def measures(past: History, weights: Array) -> Row:
    """How near the weighted replay is to the policy's own stream.

    `distance`: total variation of (s, a, s'); `ends`: the weight on transitions that end an episode
    over the policy's share; `ess`: the effective sample as a share of the rows.
    """
    mass, p = past.mass, transition_occupancy(past.mdp, past.target, "stationary")
    weighted = mass * weights
    mean, square = weighted.sum(), (weighted * weights).sum()
    replay, terminal = weighted.sum(0) / mean, past.mdp.terminal
    return {
        "distance": float(np.abs(replay - p).sum() / 2),
        "ends": float(replay[..., terminal].sum() / p[..., terminal].sum()),
        "ess": float(mean**2 / square),
    }


def exact_ways(seeds: Iterable[int]) -> list[Row]:
    """The median of each measure over MDPs in which one step in a hundred ends an episode."""
    asked = [c for c in ending_cases(seeds, "stationary") if c.divergence == "chi2"]
    pasts = [history(*draw(case, np.random.default_rng(case.seed))) for case in asked]
    found: dict[str, list[Row]] = {}
    for past in pasts:
        for way, weights in weights_of(past).items():
            found.setdefault(way, []).append(measures(past, weights))
    return [
        {"way": way, "problems": len(rows)}
        | {name: float(np.median([row[name] for row in rows])) for name in rows[0]}
        for way, rows in found.items()
    ]
