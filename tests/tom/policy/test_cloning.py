import pytest
import torch
from common import generator

from tom.data.transitions import TensorTransitions
from tom.policy.foreign import clone


def test_the_clone_finds_mean_and_noise_of_the_policy():
    g = generator()
    obs = torch.rand(2000, 2, generator=g)
    mean = torch.stack([obs[:, 0] - 0.5, 0.3 - 0.6 * obs[:, 1]], -1)
    action = mean + torch.tensor([0.05, 0.2]) * torch.randn(2000, 2, generator=g)
    flags = torch.zeros(2000)
    policy = clone(TensorTransitions(obs, action, flags, obs, flags, flags), g)
    error = policy.mean(obs).detach() - mean
    assert error.square().mean().sqrt() < 0.03
    assert policy.std.tolist() == pytest.approx([0.05, 0.2], abs=0.02)
    drawn = policy(obs[:1], 5000, g)
    assert drawn.shape == (5000, 1, 2)
    assert drawn[:, 0].std(0).tolist() == pytest.approx(policy.std.tolist(), rel=0.05)
    assert drawn.abs().max() <= 1
