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

from tom.backprop import forward_trace, input_gradient, set_gradients
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
        self.temperature_optimiser = torch.optim.Adam([self.log_temperature], config.lr, fused=True)

    @torch.no_grad()
    def update(self, batch: TensorTransitions) -> dict[str, Tensor]:
        """One gradient step of critics, actor and temperature on a (M, B, ...) batch.

        Returns what it measured, (M,) each. Gradients are written out by hand (see `backprop`).
        """
        critic_loss, q = self.set_critic_gradients(batch)
        self.critic_optimiser.step()
        actor_loss, log_prob = self.set_actor_gradients(batch.obs)
        self.actor_optimiser.step()
        # d/d log_temperature of -log_temperature * (log_prob + target_entropy)
        self.log_temperature.grad = -(log_prob + self.target_entropy)
        self.temperature_optimiser.step()
        torch._foreach_lerp_(  # pyright: ignore[reportPrivateImportUsage]
            list(self.target_critic.parameters()),
            list(self.critic.parameters()),
            self.config.tau,
        )
        return {
            "critic/loss": critic_loss,
            "critic/q": q,
            "actor/loss": actor_loss,
            "actor/entropy": -log_prob,
            "temperature/value": self.log_temperature.exp(),
        }

    def critic_target(self, batch: TensorTransitions) -> Tensor:
        """r + g (1 - terminated) (min_k Q'_k(s', a') - temperature log pi(a'|s')), (M, B).

        Bootstraps through truncation, never through termination.
        """
        action, log_prob = self._sample(batch.next_obs)
        next_q = self.target_critic(self._twin_inputs(batch.next_obs, action))
        soft_value = _twins(next_q).amin(1) - self._temperature() * log_prob.squeeze(-1)
        return batch.reward + self.config.discount * (1.0 - batch.terminated) * soft_value

    def set_critic_gradients(self, batch: TensorTransitions) -> tuple[Tensor, Tensor]:
        """Gradients of sum_k E[(Q_k(s, a) - target)^2]; returns the loss and the mean Q, (M,)."""
        target = self.critic_target(batch)
        trace = forward_trace(self.critic, self._twin_inputs(batch.obs, batch.action))
        error = _twins(trace[-1]) - target.unsqueeze(1)  # (M, 2, B)
        grad = error * (2.0 / error.shape[-1])
        set_gradients(self.critic, trace, grad.flatten(0, 1).unsqueeze(-1))
        return error.square().mean(-1).sum(1), _twins(trace[-1]).mean((1, 2))

    def set_actor_gradients(self, obs: Tensor) -> tuple[Tensor, Tensor]:
        """Gradients of E[temperature log pi(a|s) - min_k Q_k(s, a)]; the loss, mean log_prob."""
        trace = forward_trace(self.actor, obs)
        mean, raw_log_std = trace[-1].chunk(2, -1)
        log_std = raw_log_std.clamp(LOG_STD_MIN, LOG_STD_MAX)
        noise = normal(self.generators, mean.shape[1:])
        action, log_prob = squashed_gaussian(mean, log_std, noise)
        q_trace = forward_trace(self.critic, self._twin_inputs(obs, action))
        q, lower = _twins(q_trace[-1]).min(1)  # (M, B)

        # -1/B flows into the lower of the two critics, and on to the action.
        grad_q = torch.zeros_like(_twins(q_trace[-1]))
        grad_q.scatter_(1, lower.unsqueeze(1), -1.0 / q.shape[-1])
        grad_input = input_gradient(self.critic, q_trace, grad_q.flatten(0, 1).unsqueeze(-1))
        grad_action = _twins(grad_input)[..., obs.shape[-1] :].sum(1)
        # a = tanh(u), u = mean + std noise: da/du = 1 - a^2, d log_prob/du = 2 a, and log_std
        # also stands in log_prob itself, with slope -1.
        share = self._temperature().unsqueeze(-1) / q.shape[-1]
        grad_u = grad_action * (1.0 - action.square()) + 2.0 * share * action
        grad_log_std = grad_u * log_std.exp() * noise - share
        grad_log_std.mul_(raw_log_std == log_std)  # nothing flows where it was clamped
        set_gradients(self.actor, trace, torch.cat([grad_u, grad_log_std], -1))

        log_prob = log_prob.squeeze(-1)
        loss = (self._temperature() * log_prob - q).mean(1)
        return loss, log_prob.mean(1)

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
        return self.log_temperature.detach().exp().unsqueeze(-1)  # (M, 1)

    def _twin_inputs(self, obs: Tensor, action: Tensor) -> Tensor:
        """What both critics read, (2 M, B, O + A)."""
        return torch.cat([obs, action], -1).repeat_interleave(2, 0)

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


def _twins(x: Tensor) -> Tensor:
    """(2 M, B, D) -> (M, 2, B, D); a D of one is dropped."""
    return x.unflatten(0, (-1, 2)).squeeze(-1)
