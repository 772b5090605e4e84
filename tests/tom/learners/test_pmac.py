from dataclasses import replace

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from made import context, rows
from torch import Tensor

from tom.config import ModelConfig, PmacConfig
from tom.learners.pmac import PmacLearner, recency_probabilities


def by_recursion(policy_version: Tensor, decay: float) -> Tensor:
    """The paper's recursion as it reads, one policy change at a time."""
    versions = sorted(set(policy_version.tolist()))
    p = torch.zeros(len(policy_version), dtype=torch.float64)
    p[policy_version == versions[0]] = 1.0 / int((policy_version == versions[0]).sum())
    for version in versions[1:]:
        current = policy_version == version
        p *= decay
        p[current] = (1 - decay) / int(current.sum())
    return p


@settings(deadline=None)
@given(
    counts=st.lists(st.integers(0, 4), min_size=1, max_size=30).filter(any),
    decay=st.floats(0.05, 0.999),
)
def test_closed_form_is_the_recursion_and_sums_to_one(counts, decay):
    version = torch.repeat_interleave(torch.arange(len(counts)), torch.tensor(counts))
    p = recency_probabilities(version, decay)
    torch.testing.assert_close(p, by_recursion(version, decay), rtol=1e-10, atol=0)
    assert float(p.sum()) == pytest.approx(1.0)


def test_weights_follow_the_version_not_the_position():
    version = torch.tensor([2, 0, 1, 0, 2])
    p = recency_probabilities(version, 0.5)
    torch.testing.assert_close(p, by_recursion(version, 0.5))


def test_no_fit_clips_its_weights():
    """As the released code, which clips probabilities at ten; TOM's weights it does clip."""
    found = PmacLearner(PmacConfig()).weigh(context(rows(4000), policy_version=torch.arange(4000)))
    assert float(found.weights.max()) > 15
    assert torch.equal(found.for_fit(ModelConfig())[0], found.weights)
    clipped = replace(found, clipped=True)
    assert torch.equal(clipped.for_fit(ModelConfig())[0], found.weights.clamp(max=10.0))
