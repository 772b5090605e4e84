from dataclasses import fields

import pytest
import torch
from common import generator
from torch.distributions import Independent, Normal, TanhTransform, TransformedDistribution

from tom.config import SacConfig
from tom.data.transitions import TensorTransitions
from tom.nn.mlp import StackedMLP
from tom.policy.sac import Sac, squashed_gaussian

OBS, ACTION, BATCH = 3, 2, 64


def make(seed: int, **changes: float) -> Sac:
    config = SacConfig(hidden=32).but(**changes)
    return Sac(OBS, ACTION, config, generator(seed))


def batch(seed: int = 0, **flags: float) -> TensorTransitions:
    g = generator(seed)
    return TensorTransitions(
        torch.randn(BATCH, OBS, generator=g),
        torch.rand(BATCH, ACTION, generator=g) * 2 - 1,
        torch.randn(BATCH, generator=g),
        torch.randn(BATCH, OBS, generator=g),
        torch.full((BATCH,), flags.get("terminated", 0.0)),
        torch.full((BATCH,), flags.get("truncated", 0.0)),
    )


def test_log_prob_of_the_squashed_gaussian_is_the_transformed_density():
    mean, log_std = torch.randn(1, 8, ACTION), torch.randn(1, 8, ACTION) * 0.3
    noise = torch.randn(1, 8, ACTION)
    action, log_prob = squashed_gaussian(mean, log_std, noise)
    density = TransformedDistribution(
        Independent(Normal(mean.double(), log_std.double().exp()), 1), [TanhTransform(cache_size=1)]
    )
    torch.testing.assert_close(
        log_prob.squeeze(-1).double(), density.log_prob(action.double()), rtol=1e-3, atol=1e-3
    )


def autograd_critic_loss(sac: Sac, rows: TensorTransitions, noise: torch.Tensor) -> torch.Tensor:
    """The critics' loss as the paper writes it, for autograd: the slow reference."""
    with torch.no_grad():
        target = sac.critic_target(rows, noise)
    x = torch.cat([rows.obs, rows.action], -1)
    q = sac.critic(torch.stack([x, x])).squeeze(-1)
    return (q - target).square().mean(-1).sum()


def autograd_actor_loss(sac: Sac, obs: torch.Tensor, noise: torch.Tensor) -> torch.Tensor:
    mean, log_std = sac.actor(obs[None])[0].chunk(2, -1)
    action, log_prob = squashed_gaussian(mean, log_std.clamp(-20, 2), noise)
    x = torch.cat([obs, action], -1)
    q = sac.critic(torch.stack([x, x])).squeeze(-1).amin(0)
    return (sac.log_temperature.detach().exp() * log_prob.squeeze(-1) - q).mean()


def assert_gradients_match(net: StackedMLP, found: list[torch.Tensor], loss: torch.Tensor) -> None:
    expected = torch.autograd.grad(loss, list(net.parameters()))
    for gradient, reference in zip(found, expected, strict=True):
        torch.testing.assert_close(gradient, reference, rtol=1e-5, atol=1e-8)


def double(sac: Sac, rows: TensorTransitions) -> TensorTransitions:
    for net in (sac.actor, sac.critic, sac.target_critic):
        net.double()
    return TensorTransitions(*(getattr(rows, f.name).double() for f in fields(rows)))


def drawn(sac: Sac) -> torch.Tensor:
    return torch.randn(BATCH, ACTION, generator=sac.generator).double()


def test_critic_gradients_are_autograds():
    sac = make(0)
    rows, noise = double(sac, batch(terminated=0.0)), drawn(sac)
    found, error, _ = sac.critic_gradients(rows, noise)
    sac.critic.requires_grad_()
    reference = autograd_critic_loss(sac, rows, noise)
    torch.testing.assert_close(error.square().mean(-1).sum(), reference.detach())
    assert_gradients_match(sac.critic, found, reference)


@pytest.mark.parametrize("spread", [0.0, 40.0])  # the second clamps most of log_std
def test_actor_gradients_are_autograds(spread: float):
    sac = make(0)
    rows, noise = double(sac, batch()), drawn(sac)
    sac.actor.biases[-1][..., ACTION:] += spread * torch.linspace(-1, 1, ACTION)
    found, loss, _ = sac.actor_gradients(rows.obs, noise)
    sac.actor.requires_grad_()
    reference = autograd_actor_loss(sac, rows.obs, noise)
    torch.testing.assert_close(loss.mean(), reference.detach())
    assert_gradients_match(sac.actor, found, reference)


def test_target_bootstraps_through_truncation_but_not_through_termination():
    plain, truncated, terminated = (
        make(0).critic_target(rows, torch.zeros(BATCH, ACTION))
        for rows in (batch(), batch(truncated=1.0), batch(terminated=1.0))
    )
    assert torch.equal(truncated, plain)
    assert torch.equal(terminated, batch().reward)
    assert not torch.equal(plain, terminated)


def test_update_moves_targets_by_tau():
    sac = make(0, tau=0.25)
    before = [p.clone() for p in sac.target_critic.parameters()]
    sac.update(batch())
    after = list(sac.target_critic.parameters())
    for old, online, new in zip(before, sac.critic.parameters(), after, strict=True):
        torch.testing.assert_close(new, old + 0.25 * (online - old))


def test_temperature_falls_when_entropy_is_above_its_target():
    sac = make(0, target_entropy=-50.0)
    before = float(sac.log_temperature)
    sac.update(batch())
    assert float(sac.log_temperature) < before


def test_updates_in_one_go_are_the_updates_one_by_one():
    together, single = make(0), make(0)
    rows = [batch(seed=step) for step in range(5)]
    measured = together.updates(torch.stack([one.packed() for one in rows]))
    last = [single.update(one) for one in rows][-1]
    assert all(torch.equal(measured[k], last[k]) for k in last)


def test_value_gradient_matches_finite_differences_for_each_head():
    sac = make(0)
    for net in (sac.actor, sac.critic):
        net.double()
    policy = sac.policy

    def values(obs: torch.Tensor) -> torch.Tensor:
        return policy._heads(obs, policy.mean(obs))

    obs = torch.randn(3, OBS, dtype=torch.float64)
    gradient = policy.value_gradient(obs)
    for d in range(OBS):
        shift = torch.zeros(OBS, dtype=torch.float64)
        shift[d] = 1e-6
        slope = (values(obs + shift) - values(obs - shift)) / 2e-6
        torch.testing.assert_close(gradient[:, :, d], slope.detach(), rtol=1e-4, atol=1e-6)


def test_learns_a_one_step_bandit():
    """Reward -(a - 0.5)^2, every step terminal: the mean action must go to 0.5."""
    sac = Sac(1, 1, SacConfig(hidden=32, lr=3e-3), generator())
    g = generator(1)
    for _ in range(400):
        action = torch.rand(128, 1, generator=g) * 2 - 1
        zeros, ones = torch.zeros(128, 1), torch.ones(128)
        reward = -10 * (action.squeeze(-1) - 0.5).square()
        sac.update(TensorTransitions(zeros, action, reward, zeros, ones, 0 * ones))
    assert abs(float(sac.policy.mean(torch.zeros(1, 1))) - 0.5) < 0.1


def test_a_members_draws_and_values_are_those_that_its_critics_are_trained_on():
    """Q's target at a truncated row, by the online critics: r + g (Q(s', a') - alpha log pi)."""
    sac = make(3, discount=0.9)
    sac.log_temperature.fill_(-0.7)
    one, member = batch(truncated=1.0), sac.policy
    noise = torch.randn(BATCH, ACTION, generator=generator(5))
    target = sac.critic_target(one, noise)
    action, log_prob = member.draw(one.next_obs, generator(5))
    soft = member.value(one.next_obs, action) - sac.log_temperature.exp() * log_prob
    torch.testing.assert_close(one.reward + 0.9 * soft, target)
