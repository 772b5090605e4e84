from dataclasses import replace

import numpy as np
import pytest
import torch
from common import generator

from tom.config import ModelConfig
from tom.data.transitions import TensorTransitions
from tom.dynamics.linear import LinearDynamics, LinearModel


def rows(count: int, seed: int = 0) -> TensorTransitions:
    """Noisy transitions that no linear model fits."""
    g = generator(seed)
    obs, action = torch.randn(count, 2, generator=g), torch.randn(count, 3, generator=g)
    next_obs = obs.sin() + action[:, :2] * obs.abs() + 0.1 * torch.randn(count, 2, generator=g)
    reward = obs[:, 0] - 2 * action[:, 2] + 0.5 + 0.3 * torch.randn(count, generator=g)
    return TensorTransitions(obs, action, reward, next_obs, torch.zeros(count), torch.zeros(count))


def lstsq(data: TensorTransitions) -> np.ndarray:
    inputs = np.hstack([data.obs.numpy(), data.action.numpy(), np.ones((len(data), 1))])
    return np.linalg.lstsq(inputs, data.next_obs.numpy(), rcond=None)[0].T


def test_weights_count_as_repeated_rows():
    data = rows(60)
    repeats = torch.arange(60) % 4  # some rows not at all
    expected = lstsq(data[torch.arange(60).repeat_interleave(repeats)])
    model = LinearModel.fit(data, 0.37 * repeats.float())  # their scale is free
    np.testing.assert_allclose(model.coefficients.numpy(), expected, atol=1e-5)


def test_each_dimension_may_have_its_own_weights():
    data = rows(60)
    w = torch.rand(60, 2, generator=generator(1))
    model = LinearModel.fit(data, w)
    for d in range(2):
        alone = LinearModel.fit(data, w[:, d])
        torch.testing.assert_close(model.coefficients[d], alone.coefficients[d])


def test_a_dimension_without_any_weight_counts_every_row_the_same():
    """VaGram gives none to a dimension that never changes (Reacher's goal)."""
    data = rows(60)
    none = torch.rand(60, 2, generator=generator(1)) * torch.tensor([1.0, 0.0])
    assert torch.equal(
        LinearModel.fit(data, none).coefficients[1],
        LinearModel.fit(data, torch.ones(60)).coefficients[1],
    )
    models = [LinearDynamics(2, 3, ModelConfig(), generator()) for _ in range(2)]
    same = torch.stack((none[:, 0], torch.ones(60)), 1)
    reports = [
        model.fit(data, torch.ones(60), per_dim, generator())
        for model, per_dim in zip(models, (none, same), strict=True)
    ]
    assert torch.equal(models[0].std, models[1].std)
    assert reports[0] == reports[1]


def test_a_true_linear_system_is_found_and_predicted():
    data = rows(50)
    true = torch.tensor([[1.0, 0, 0.04, 0, 0, 0.1], [0.2, 0.9, 0, 0.04, 0.3, 0]])
    inputs = torch.cat([data.obs, data.action, torch.ones(50, 1)], -1)
    linear = replace(data, next_obs=inputs @ true.T)
    model = LinearModel.fit(linear, torch.rand(50, generator=generator()))
    torch.testing.assert_close(model.coefficients, true, atol=1e-5, rtol=0)
    found = model.next_obs(data.obs, data.action)
    torch.testing.assert_close(found, linear.next_obs, atol=1e-5, rtol=0)


def test_the_dynamics_model_also_learns_reward_and_noise():
    data, g = rows(4000), generator()
    model = LinearDynamics(2, 3, ModelConfig(), g)
    report = model.fit(data, torch.ones(4000), None, g)
    assert model.coefficients[0].tolist() == pytest.approx([1, 0, 0, 0, -2, 0.5], abs=0.03)
    assert model.std[0].item() == pytest.approx(0.3, rel=0.05)
    np.testing.assert_allclose(model.coefficients[1:].numpy(), lstsq(data), atol=1e-4)
    obs, action = data.obs[:1].expand(20_000, 2), data.action[:1].expand(20_000, 3)
    reward, next_obs = model.sample(obs, action, g)
    mean_reward, mean_next = model.predict(data.obs[:1], data.action[:1])
    assert reward.mean().item() == pytest.approx(mean_reward.item(), abs=0.01)
    torch.testing.assert_close(next_obs.mean(0), mean_next[0], atol=0.04, rtol=0)
    torch.testing.assert_close(next_obs.std(0), model.std[1:], rtol=0.03, atol=0)
    residual = torch.distributions.Normal(0, model.std)
    inputs = torch.cat([data.obs, data.action, torch.ones(4000, 1)], -1)
    targets = torch.cat([data.reward[:, None], data.next_obs], -1)
    nll = -residual.log_prob(targets - inputs @ model.coefficients.T).mean()
    assert report.metrics["model/train_nll"] == pytest.approx(nll.item(), abs=1e-4)


def test_the_likelihood_of_the_rows_it_was_fitted_to_is_the_fits():
    data = rows(60)
    model = LinearDynamics(2, 3, ModelConfig(kind="linear"), generator())
    report = model.fit(data, torch.ones(60), None, generator())
    nll = model.nll(data)
    assert nll.shape == (60, 3)
    assert float(nll.mean()) == pytest.approx(report.metrics["model/train_nll"], rel=1e-4)
