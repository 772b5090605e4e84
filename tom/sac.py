"""Soft actor-critic (Haarnoja et al. 2018) with a learnt temperature, for M members at once.

Everything has a leading member axis M: a member is one seed of one learner. Members share no
parameter and no random number, so each trains as it would alone.
"""

from copy import deepcopy
from math import log
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import relu, softplus

from tom.config import SacConfig
from tom.data.transitions import TensorTransitions
from tom.nn import StackedMLP
from tom.rng import Generators, normal

LOG_STD_MIN, LOG_STD_MAX = -20.0, 2.0


def squashed_gaussian(mean: Tensor, log_std: Tensor, noise: Tensor) -> tuple[Tensor, Tensor]:
    """Action tanh(u), u ~ N(mean, std), and its log_prob (..., 1), from standard normal `noise`.

    log pi(a) = log N(u) - sum log(1 - tanh(u)^2), the last term in its stable form
    2 (log 2 - u - softplus(-2u)).
    """
    u = mean + log_std.exp() * noise
    log_normal = -0.5 * noise.square() - log_std - 0.5 * log(2 * torch.pi)
    log_slope = 2.0 * (log(2.0) - u - softplus(-2.0 * u))
    return torch.tanh(u), (log_normal - log_slope).sum(-1, keepdim=True)


class Sac:
    """Actor, twin critics, their targets and the temperature of M members."""

    def __init__(
        self, obs_dim: int, action_dim: int, config: SacConfig, generators: Generators
    ) -> None:
        members, hidden = len(generators), [config.hidden] * config.layers
        self.config = config
        self.generators = generators
        self.target_entropy = (
            float(-action_dim) if config.target_entropy is None else config.target_entropy
        )
        self.actor = StackedMLP(members, [obs_dim, *hidden, 2 * action_dim], relu, generators)
        self.critic = StackedMLP(2 * members, [obs_dim + action_dim, *hidden, 1], relu, generators)
        self.target_critic = deepcopy(self.critic).requires_grad_(False)
        self.log_temperature = torch.full(
            (members,), log(config.initial_temperature), requires_grad=True
        )
        self.actor_optimiser = torch.optim.Adam(self.actor.parameters(), config.lr, fused=True)
        self.critic_optimiser = torch.optim.Adam(self.critic.parameters(), config.lr, fused=True)
        self.temperature_optimiser = torch.optim.Adam([self.log_temperature], config.lr)

    # The three losses, one number a member: (M,)

    def critic_loss(self, batch: TensorTransitions) -> tuple[Tensor, Tensor]:
        """Squared Bellman error of both critics; bootstraps through truncation. Also mean Q."""
        with torch.no_grad():
            next_action, next_log_prob = self._sample(batch.next_obs)
            next_q = self._twin_q(self.target_critic, batch.next_obs, next_action).amin(1)
            soft_value = next_q - self._temperature() * next_log_prob
            alive = 1.0 - batch.terminated.unsqueeze(-1)
            target = batch.reward.unsqueeze(-1) + self.config.discount * alive * soft_value
        q = self._twin_q(self.critic, batch.obs, batch.action)  # (M, 2, B, 1)
        loss = (q - target.unsqueeze(1)).square().mean((2, 3)).sum(1)
        return loss, q.detach().mean((1, 2, 3))

    def actor_loss(self, obs: Tensor) -> tuple[Tensor, Tensor]:
        """E[temperature log pi(a|s) - min_k Q_k(s, a)]; also the batch's mean log_prob."""
        action, log_prob = self._sample(obs)
        q = self._twin_q(self.critic, obs, action, frozen=True).amin(1)
        loss = (self._temperature() * log_prob - q).mean((1, 2))
        return loss, log_prob.detach().mean((1, 2))

    def update(self, batch: TensorTransitions) -> dict[str, Tensor]:
        """One gradient step of critics, actor and temperature on a (M, B, ...) batch."""
        critic_loss, q = self.critic_loss(batch)
        _step(self.critic_optimiser, critic_loss)
        actor_loss, log_prob = self.actor_loss(batch.obs)
        _step(self.actor_optimiser, actor_loss)
        temperature_loss = -self.log_temperature * (log_prob + self.target_entropy)
        _step(self.temperature_optimiser, temperature_loss)
        with torch.no_grad():
            torch._foreach_lerp_(  # pyright: ignore[reportPrivateImportUsage]
                list(self.target_critic.parameters()),
                list(self.critic.parameters()),
                self.config.tau,
            )
        return {
            "critic/loss": critic_loss.detach(),
            "critic/q": q,
            "actor/loss": actor_loss.detach(),
            "actor/entropy": -log_prob,
            "temperature/value": self.log_temperature.detach().exp(),
        }

    # Acting

    @torch.no_grad()
    def act(self, obs: Tensor) -> Tensor:
        """Sampled actions for obs (M, B, O): (M, B, A)."""
        return self._sample(obs)[0]

    @torch.no_grad()
    def act_mean(self, obs: Tensor) -> Tensor:
        """Mean actions for obs (M, B, O): (M, B, A)."""
        return torch.tanh(self._gaussian(obs)[0])

    def member(self, index: int = 0) -> "MemberPolicy":
        """Member `index` alone, without the member axis."""
        return MemberPolicy(self, index)

    # Parts

    def _gaussian(self, obs: Tensor) -> tuple[Tensor, Tensor]:
        mean, log_std = self.actor(obs).chunk(2, -1)
        return mean, log_std.clamp(LOG_STD_MIN, LOG_STD_MAX)

    def _sample(self, obs: Tensor) -> tuple[Tensor, Tensor]:
        mean, log_std = self._gaussian(obs)
        return squashed_gaussian(mean, log_std, normal(self.generators, mean.shape[1:]))

    def _temperature(self) -> Tensor:
        return self.log_temperature.detach().exp().view(-1, 1, 1)

    def _twin_q(
        self, critic: StackedMLP, obs: Tensor, action: Tensor, frozen: bool = False
    ) -> Tensor:
        """Both critics' values (M, 2, B, 1)."""
        x = torch.cat([obs, action], -1).repeat_interleave(2, 0)
        q = critic.frozen(x) if frozen else critic(x)
        return q.unflatten(0, (-1, 2))

    def state_dict(self) -> dict[str, Any]:
        return {
            "actor": self.actor.state_dict(),
            "critic": self.critic.state_dict(),
            "target_critic": self.target_critic.state_dict(),
            "log_temperature": self.log_temperature.detach().clone(),
            "actor_optimiser": self.actor_optimiser.state_dict(),
            "critic_optimiser": self.critic_optimiser.state_dict(),
            "temperature_optimiser": self.temperature_optimiser.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        for name in ("actor", "critic", "target_critic"):
            getattr(self, name).load_state_dict(state[name])
        for name in ("actor_optimiser", "critic_optimiser", "temperature_optimiser"):
            # An optimiser would keep the very tensors of the state it is given.
            getattr(self, name).load_state_dict(deepcopy(state[name]))
        with torch.no_grad():
            self.log_temperature.copy_(state["log_temperature"])


class GaussianPolicy:
    """Network `index` of an actor as a policy (`tom.learners.base.Policy`)."""

    def __init__(self, actor: StackedMLP, index: int) -> None:
        self._actor = actor
        self._index = index

    @torch.no_grad()
    def __call__(self, obs: Tensor, n: int, generator: torch.Generator) -> Tensor:
        """n sampled actions for obs (B, O): (n, B, A)."""
        mean, log_std = self._gaussian(obs)
        noise = torch.randn(n, *mean.shape, generator=generator)
        return torch.tanh(mean + log_std.exp() * noise)

    @torch.no_grad()
    def mean(self, obs: Tensor) -> Tensor:
        """Mean actions for obs (B, O): (B, A)."""
        return torch.tanh(self._gaussian(obs)[0])

    def _gaussian(self, obs: Tensor) -> tuple[Tensor, Tensor]:
        mean, log_std = self._actor.member(self._index, obs).chunk(2, -1)
        return mean, log_std.clamp(LOG_STD_MIN, LOG_STD_MAX)


class MemberPolicy(GaussianPolicy):
    """One member of a SAC: its policy and its value heads."""

    def __init__(self, sac: Sac, index: int) -> None:
        super().__init__(sac.actor, index)
        self._critic = sac.critic

    def value_gradient(self, obs: Tensor) -> Tensor:
        """dV_k/ds of both critics' V_k(s) = Q_k(s, mean action(s)) at obs (B, O): (2, B, O)."""
        state = obs.detach().clone().requires_grad_(True)
        q = self._values(state)  # (2, B)
        heads = [torch.autograd.grad(q[k].sum(), state, retain_graph=k == 0)[0] for k in (0, 1)]
        return torch.stack(heads)

    def _values(self, obs: Tensor) -> Tensor:
        action = torch.tanh(self._gaussian(obs)[0])
        x = torch.cat([obs, action], -1)
        heads = [self._critic.member(2 * self._index + k, x).squeeze(-1) for k in (0, 1)]
        return torch.stack(heads)


def _step(optimiser: torch.optim.Optimizer, loss: Tensor) -> None:
    optimiser.zero_grad(set_to_none=True)
    loss.sum().backward()  # members share nothing: the sum gives each its own gradient
    optimiser.step()
