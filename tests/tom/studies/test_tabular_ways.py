"""The exact weights of ways that train no network, against streams and plain loops."""

from collections import Counter, defaultdict
from dataclasses import replace
from functools import cache
from math import log, sqrt

import numpy as np
import pytest

from tom.studies.mdp import random_mdp, random_policy, sample_stream, with_endings
from tom.studies.tabular_ways import OVER_BUFFER, History, exact_ways, history, measures, weights_of

STREAM = 30_000


@pytest.fixture(scope="module")
def past() -> History:
    rng = np.random.default_rng(3)
    mdp = with_endings(random_mdp(5, 2, 2, 0.9, rng), 0.05, rng)
    target, behaviour = (random_policy(mdp, rng, uniform=share) for share in (0.1, 0.3))
    return history(mdp, target, behaviour)


@pytest.fixture(scope="module")
def rows(past: History) -> list[tuple[int, int, int, int]]:
    """The replay as streams: (k, s, a, s') of every step."""
    streams = [
        sample_stream(past.mdp, policy, STREAM, np.random.default_rng(k))[1].tolist()
        for k, policy in enumerate(past.policies)
    ]
    return [(k, s, a, s_next) for k, stream in enumerate(streams) for s, a, s_next in stream]


def by_hand(past: History, rows: list[tuple[int, int, int, int]]) -> dict[str, list[float]]:
    """The weight of every row by each way, by loops over rows and counts of them."""
    now, then = past.target.tolist(), past.policies.tolist()

    @cache
    def divergence(k: int, s: int) -> float:
        return sum(p * log(p / q) for p, q in zip(now[s], then[k][s], strict=True))

    bounds: list[list[float]] = [[] for _ in then]
    counted, pairs = Counter((s, a) for _, s, a, _ in rows), Counter(row[1:] for row in rows)
    for k, s, _, _ in rows:
        bounds[k].append(sqrt(divergence(k, s) / 2) if k else 0.0)
    of_policy = [STREAM / sum(each) if k else 0.0 for k, each in enumerate(bounds)]
    of_policy[-1] = max(0.02 / 0.98 * sum(of_policy[1:-1]), *of_policy[1:-1])
    of_policy[0] = 0.05 * of_policy[1]
    errors = {}
    for s, a, s_next in pairs:
        model = [pairs[s, a, i] / counted[s, a] for i in range(past.mdp.states)]
        wrong = [(i == s_next) - share for i, share in enumerate(model)]
        errors[s, a, s_next] = sqrt(sum(x * x for x in wrong) / len(wrong))
    mean_error = sum(errors[row[1:]] for row in rows) / len(rows)
    return {
        "uniform": [1.0 for _ in rows],
        "recency": [0.7 ** (8 - k) * (0.3 if k else 1) for k, *_ in rows],
        "pdml": [of_policy[k] for k, *_ in rows],
        "policy-distance": [1 / (divergence(k, s) + 0.05) if k else 0.0 for k, s, _, _ in rows],
        "action-ratio": [min(now[s][a] / then[k][s][a], 10.0) for k, s, a, _ in rows],
        "pmer": [0.5 + 0.5 * errors[row[1:]] / mean_error for row in rows],
    }


def test_exact_measures_are_those_of_streams(past: History, rows: list[tuple[int, int, int, int]]):
    own = Counter(
        map(
            tuple,
            sample_stream(past.mdp, past.target, 200_000, np.random.default_rng(9))[1].tolist(),
        )
    )
    end = past.mdp.states - 1
    own_ends = sum(n for (_, _, s_next), n in own.items() if s_next == end) / 200_000
    exact = weights_of(past)
    for way, weights in by_hand(past, rows).items():
        total = sum(weights)
        replay = defaultdict[tuple[int, ...], float](float)
        for row, weight in zip(rows, weights, strict=True):
            replay[row[1:]] += weight / total
        apart = sum(abs(replay[row] - own[row] / 200_000) for row in {*replay, *own}) / 2
        ends = sum(share for (_, _, s_next), share in replay.items() if s_next == end)
        found = measures(past, exact[way])
        assert found["distance"] == pytest.approx(apart, abs=0.01), way
        assert found["ends"] == pytest.approx(ends / own_ends, rel=0.05), way
        square = sum(weight * weight for weight in weights)
        assert found["ess"] == pytest.approx(total * total / square / len(rows), rel=0.01), way


def test_a_replay_of_the_policy_itself_is_at_no_distance(past: History):
    same = replace(past, policies=np.repeat(past.target[None], 4, 0))
    for way, weights in weights_of(same).items():
        if way not in ("pmer", "policy-distance", "pdml", OVER_BUFFER):
            assert measures(same, weights)["distance"] < 1e-12, way
    # Their weights are constant but for what stands for exploration, the policy's as well here.
    for way in ("policy-distance", "pdml"):
        assert measures(same, weights_of(same)[way])["distance"] < 1e-12
    assert measures(same, weights_of(same)["pmer"])["distance"] > 0.01


def test_the_action_ratio_is_nearest_and_error_looks_away_from_the_policy():
    """What the exact weights say of MDPs, which robots need not share."""
    found = {row["way"]: row for row in exact_ways(range(2))}
    uniform = found["uniform"]["distance"]
    assert found["action-ratio"]["distance"] == min(row["distance"] for row in found.values())
    assert found["pmer"]["distance"] > uniform
    assert found["pdml"]["distance"] == pytest.approx(found[OVER_BUFFER]["distance"], rel=0.05)
