"""The terms of a weight sum to the weight, under every flow and divergence."""

import numpy as np
import pytest
import torch
from common import generator
from made import OBS, QUICK, ended, rows, uniform_policy
from torch import Tensor

from tom.analysis import why
from tom.config import TomConfig
from tom.data.sampling import normalise
from tom.data.transitions import TensorTransitions
from tom.learners.terms import Terms
from tom.learners.tom import occupancy_weights

FLOWS = ("discounted", "restart", "stationary")
DIVERGENCES = (
    ("chi2", "clamped"),
    ("chi2", "released"),
    ("full-chi2", "clamped"),
    ("kl", "clamped"),
)


def buffer() -> TensorTransitions:
    """Rows near the policy and far from it, ends of both kinds among them."""
    parts = [rows(150, seed=1, shift=1.0), rows(500, seed=2)]
    parts += [ended(rows(25, seed=3), "terminated"), ended(rows(25, seed=4), "truncated")]
    return TensorTransitions.join(parts)


def found(config: TomConfig) -> tuple[Tensor, Terms]:
    """Weights and their terms."""
    starts = torch.zeros(4, OBS)
    rows_of = buffer(), rows(120, seed=1, shift=1.0)
    weighting = occupancy_weights(*rows_of, uniform_policy, starts, config, generator(2))
    assert weighting.terms is not None
    return weighting.weights, weighting.terms


@pytest.mark.parametrize("flow", FLOWS)
@pytest.mark.parametrize(("divergence", "conjugate"), DIVERGENCES)
def test_the_terms_sum_to_the_weight(flow, divergence, conjugate):
    config = QUICK.but(flow=flow, divergence=divergence, conjugate=conjugate, discount=0.9)
    weights, terms = found(config)
    assert weights.std() > 0.01
    for row in range(0, 700, 23):
        summed = why.sum_of(terms, config, row)
        assert summed.weight == pytest.approx(float(weights[row]), abs=1e-5)
    assert torch.equal(normalise(terms.raw(config))[0], weights)


def test_an_end_restarts_where_the_flow_does():
    end, limit = 660, 690
    for flow, restarts in (
        ("discounted", (False, False)),
        ("restart", (True, False)),
        ("stationary", (True, True)),
    ):
        _, terms = found(QUICK.but(flow=flow))
        assert tuple(float(terms.restart[row]) != 0 for row in (end, limit)) == restarts
        assert float(terms.restart[:650].abs().max()) == 0
        assert float(terms.following[end]) == 0
        assert (float(terms.following[limit]) == 0) == (flow == "stationary")


def test_the_level_is_what_makes_the_mean_one():
    stationary = QUICK.but(flow="stationary")
    _, terms = found(stationary)
    summed = why.sum_of(terms, stationary, 3)
    assert summed.level != 0
    assert summed.mean == pytest.approx(1, abs=1e-4)
    assert why.sum_of(found(QUICK)[1], QUICK, 3).level == 0


def test_the_nearest_of_the_policys_transitions():
    replay = buffer()
    near = why.nearest(replay, 7, replay[:150])
    assert near.index[0] == 7
    assert near.distance[0] == 0
    assert (near.distance.diff() >= 0).all()
    rest = why.nearest(replay, 7, replay[:150], itself=7)
    assert torch.equal(rest.index[:4], near.index[1:])
    assert torch.equal(rest.distance[:4], near.distance[1:])
    assert len(why.nearest(replay, 7, replay[6:9], itself=1).index) == 2
    own = why.usual_distance(replay, replay[:150], torch.arange(150))
    other = why.usual_distance(replay, replay[:150], torch.arange(150, 600))
    assert own == pytest.approx(0, abs=1e-2)
    assert other > 0.1


class Ahead:
    """A world in which every step adds one to every dimension."""

    def sample(self, obs, action, generator):
        return obs.new_zeros(len(obs)), obs + 1


def test_rollouts_start_there_and_stop_at_an_end():
    def beyond(obs):
        return obs[:, 0] >= 3

    start = torch.zeros(OBS)
    paths = why.rollouts(Ahead(), uniform_policy, beyond, start, 5, 4, generator())
    assert paths.shape == (4, 6, OBS)
    np.testing.assert_allclose(paths[0, :4, 0], [0, 1, 2, 3])
    assert paths[:, 4:].isnan().all()
