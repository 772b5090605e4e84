"""A region's weights multiplied, and what a model fitted by them loses or gains."""

from collections.abc import Sequence

import numpy as np
import pytest
import torch

from tom.analysis.brush import (
    REGION,
    REST,
    SMALL,
    BrushedFit,
    brushed_weights,
    fit_brushed,
)
from tom.config import ModelConfig
from tom.data.transitions import TensorTransitions
from tom.errors import UserError

QUICK = SMALL.but(rounds=6, hidden=8, kind="linear")


def bent(count: int = 1200) -> TensorTransitions:
    """A world that moves one way left of zero and the other way right of it: no line fits both."""
    generator = torch.Generator().manual_seed(0)
    obs = torch.rand(count, 1, generator=generator) * 2 - 1
    action = torch.zeros(count, 1)
    step = torch.where(obs > 0, obs, -2 * obs) + 0.01 * torch.randn(count, 1, generator=generator)
    zero = torch.zeros(count)
    ended = (torch.arange(count) % 20 == 19).float()
    return TensorTransitions(obs, action, zero, obs + step, zero, ended)


def fitted(config: ModelConfig, factors: Sequence[float], *seeds: int) -> list[BrushedFit]:
    rows = bent()
    return list(
        fit_brushed(rows, torch.ones(len(rows)), rows.obs[:, 0] > 0, None, config, factors, seeds)
    )


def test_nothing_left_is_refused():
    weights, region = torch.tensor([1.0, 0.0]), torch.tensor([True, False])
    with pytest.raises(UserError, match="nothing is left"):
        brushed_weights(weights, region, 0)
    rows = bent(40)
    with pytest.raises(UserError, match="not all"):
        next(
            fit_brushed(
                rows, torch.ones(40), torch.ones(40, dtype=torch.bool), None, QUICK, (), (0,)
            )
        )


def test_a_region_that_counts_less_is_modelled_worse_and_the_rest_better():
    found = {(f.factor, f.seed): f.errors for f in fitted(QUICK, (0, 0.25, 4), 0, 1)}
    for seed in (0, 1):
        as_is, without, less, more = (found[factor, seed] for factor in (1, 0, 0.25, 4))
        assert without[REGION] > less[REGION] > as_is[REGION] > more[REGION]
        assert without[REST] < less[REST] < as_is[REST] < more[REST]


def test_the_same_seed_gives_the_same_bits():
    one, again = (fitted(SMALL.but(rounds=1), (4,), 3) for _ in range(2))
    assert [f.factor for f in one] == [1, 4]
    assert [f.errors for f in one] == [f.errors for f in again]
    assert np.array_equal(one[1].weights, again[1].weights)
