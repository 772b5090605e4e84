"""Soft actor-critic (Haarnoja et al. 2018) with a learnt temperature."""

from copy import deepcopy
from math import log
from typing import Any

import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import relu, softplus

from tom.config import SacConfig
from tom.data.transitions import TensorTransitions
from tom.nn.mlp import StackedMLP, forward_trace, gradients, input_gradient
from tom.nn.trained import Adam

LOG_STD_MIN, LOG_STD_MAX = -20.0, 2.0
NETS = "actor", "critic", "target_critic"
OPTIMISERS = "actor_optimiser", "critic_optimiser", "temperature_optimiser"


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
    """Actor, twin critics, their targets and the temperature."""

    def __init__(
        self, obs_dim: int, action_dim: int, config: SacConfig, generator: torch.Generator
    ) -> None:
        hidden = [config.hidden] * config.layers
        self.config = config
        self.dims = obs_dim, action_dim
        self.generator = generator
        chosen = config.target_entropy
        self.target_entropy = float(-action_dim) if chosen is None else chosen
        self.actor = StackedMLP(1, [obs_dim, *hidden, 2 * action_dim], relu, generator)
        self.critic = StackedMLP(2, [obs_dim + action_dim, *hidden, 1], relu, generator)
        self.target_critic = deepcopy(self.critic)
        for net in (self.actor, self.critic, self.target_critic):
            net.requires_grad_(False)
        self.log_temperature = torch.full(
            (1,), log(config.initial_temperature), device=generator.device
        )
        self.actor_optimiser = Adam(self.actor.tensors(), config.lr)
        self.critic_optimiser = Adam(self.critic.tensors(), config.lr)
        self.temperature_optimiser = Adam([self.log_temperature], config.lr)
        self.policy = ActorCritic(self.actor, self.critic)

    def update(self, batch: TensorTransitions) -> dict[str, Tensor]:
        """One gradient step of critics, actor and temperature on a (B, ...) batch; its metrics."""
        return self.updates(batch.packed()[None])

    @torch.no_grad()
    def updates(self, batches: Tensor) -> dict[str, Tensor]:
        """G gradient steps on packed transitions (G, B, R); the last one's metrics, (1,) each."""
        shape = (len(batches), 2, batches.shape[1], self.dims[1])
        noise = torch.randn(*shape, generator=self.generator, device=self.generator.device)
        steps = [self._step(*drawn) for drawn in zip(batches, noise, strict=True)]
        error, q, loss, log_prob = steps[-1]
        return {
            "critic/loss": error.square().mean(-1).sum().view(1),
            "critic/q": q.mean().view(1),
            "actor/loss": loss.mean().view(1),
            "actor/entropy": -log_prob.mean().view(1),
            "temperature/value": self.log_temperature.exp(),
        }

    def _step(self, rows: Tensor, noise: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """A gradient step on packed transitions (B, R) with normal draws (2, B, A).

        The critics' errors and values (2, B), the actor's loss and log_prob (B,). Gradients are
        written out by hand (see `tom.nn.mlp`).
        """
        batch = TensorTransitions.unpack(rows, *self.dims)
        critic_gradients, error, q = self.critic_gradients(batch, noise[0])
        self.critic_optimiser.step(critic_gradients)
        actor_gradients, loss, log_prob = self.actor_gradients(batch.obs, noise[1])
        self.actor_optimiser.step(actor_gradients)
        # d/d log_temperature of -log_temperature * (log_prob + target_entropy)
        self.temperature_optimiser.step([-(log_prob.mean(0, keepdim=True) + self.target_entropy)])
        torch._foreach_lerp_(  # pyright: ignore[reportPrivateImportUsage]
            self.target_critic.tensors(), self.critic.tensors(), self.config.tau
        )
        return error, q, loss, log_prob

    def critic_target(self, batch: TensorTransitions, noise: Tensor) -> Tensor:
        """r + g (1 - terminated) (min_k Q'_k(s', a') - temperature log pi(a'|s')), (B,).

        Bootstraps through truncation, never through termination.
        """
        mean, log_std = _gaussian(forward_trace(self.actor, batch.next_obs[None])[-1][0])
        action, log_prob = squashed_gaussian(mean, log_std, noise)
        inputs = _twin_inputs(batch.next_obs, action)
        next_q = forward_trace(self.target_critic, inputs)[-1].squeeze(-1)
        temperature = self.log_temperature.exp()
        soft_value = torch.minimum(*next_q) - temperature * log_prob.squeeze(-1)
        return batch.reward + self.config.discount * (1.0 - batch.terminated) * soft_value

    def critic_gradients(
        self, batch: TensorTransitions, noise: Tensor
    ) -> tuple[list[Tensor], Tensor, Tensor]:
        """Gradients of sum_k E[(Q_k(s, a) - target)^2]; the errors and Q_k(s, a), (2, B)."""
        target = self.critic_target(batch, noise)
        trace = forward_trace(self.critic, _twin_inputs(batch.obs, batch.action))
        q = trace[-1].squeeze(-1)
        error = q - target
        grad = error * (2.0 / error.shape[-1])
        return gradients(self.critic, trace, grad.unsqueeze(-1)), error, q

    def actor_gradients(self, obs: Tensor, noise: Tensor) -> tuple[list[Tensor], Tensor, Tensor]:
        """Gradients of E[temperature log pi(a|s) - min_k Q_k(s, a)]; its terms, log pi, (B,)."""
        trace = forward_trace(self.actor, obs[None])
        output = trace[-1][0]
        mean, log_std = _gaussian(output)
        action, log_prob = squashed_gaussian(mean, log_std, noise)
        q_trace = forward_trace(self.critic, _twin_inputs(obs, action))
        first, second = q_trace[-1].squeeze(-1)
        q, first_is_lower = torch.minimum(first, second), first <= second  # (B,)

        # -1/B flows into the lower of the two critics, and on to the action.
        grad_q = torch.stack([first_is_lower, ~first_is_lower]) * (-1.0 / len(q))
        grad_input = input_gradient(self.critic, q_trace, grad_q.unsqueeze(-1))
        grad_action = grad_input[..., obs.shape[-1] :].sum(0)
        # a = tanh(u), u = mean + std noise: da/du = 1 - a^2, d log_prob/du = 2 a, and log_std
        # also stands in log_prob itself, with slope -1.
        temperature = self.log_temperature.exp()
        share = temperature / len(q)
        grad_u = grad_action * (1.0 - action.square()) + 2.0 * share * action
        grad_log_std = grad_u * log_std.exp() * noise - share
        grad_log_std.mul_(output.chunk(2, -1)[1] == log_std)  # nothing flows where clamped
        grad = torch.cat([grad_u, grad_log_std], -1)[None]
        log_prob = log_prob.squeeze(-1)
        return gradients(self.actor, trace, grad), temperature * log_prob - q, log_prob

    def state_dict(self) -> dict[str, Any]:
        nets = {name: getattr(self, name).own_state() for name in NETS}
        optimisers = {name: getattr(self, name).state_dict() for name in OPTIMISERS}
        return {**nets, "log_temperature": self.log_temperature.clone(), **optimisers}

    def load_state_dict(self, state: dict[str, Any]) -> None:
        for name in (*NETS, *OPTIMISERS):
            getattr(self, name).load_state_dict(state[name])
        self.log_temperature.copy_(state["log_temperature"])


class Actor:
    """An actor network as a policy (`tom.learners.base.Policy`)."""

    def __init__(self, actor: StackedMLP) -> None:
        self._actor = actor

    @torch.no_grad()
    def __call__(self, obs: Tensor, n: int, generator: torch.Generator) -> Tensor:
        """n sampled actions for obs (B, O): (n, B, A)."""
        mean, log_std = self.gaussian(obs)
        noise = torch.randn(n, *mean.shape, generator=generator, device=generator.device)
        return torch.tanh(mean + log_std.exp() * noise)

    @torch.no_grad()
    def act(self, obs: Tensor, generator: torch.Generator) -> tuple[NDArray, NDArray]:
        """An action (A,) for obs (O,), and the Gaussian (2 A,) that it was drawn from.

        Draws what `__call__` draws.
        """
        mean, log_std = self.gaussian(obs[None])
        noise = torch.randn(mean.shape, generator=generator, device=generator.device)
        action = torch.tanh(mean + log_std.exp() * noise)
        return action[0].cpu().numpy(), torch.cat((mean, log_std), 1)[0].cpu().numpy()

    @torch.no_grad()
    def mean(self, obs: Tensor) -> Tensor:
        """Mean actions for obs (B, O): (B, A)."""
        return torch.tanh(self.gaussian(obs)[0])

    def hidden(self, obs: Tensor) -> Tensor:
        """The actor's last hidden layer for obs (B, O): (B, H)."""
        return self._actor.hidden(0, obs.to(self._actor.layers[0][0].device))

    def gaussian(self, obs: Tensor) -> tuple[Tensor, Tensor]:
        """Mean and log standard deviation of the Gaussian before tanh for obs (B, O): (B, A)."""
        obs = obs.to(self._actor.layers[0][0].device)
        return _gaussian(self._actor.member(0, obs))


class ActorCritic(Actor):
    """SAC's policy and its two value heads."""

    def __init__(self, actor: StackedMLP, critic: StackedMLP) -> None:
        super().__init__(actor)
        self._critic = critic

    @torch.no_grad()
    def draw(self, obs: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """A sampled action (B, A) for each of obs (B, O), and its log_prob (B,)."""
        mean, log_std = self.gaussian(obs)
        noise = torch.randn(*mean.shape, generator=generator, device=generator.device)
        action, log_prob = squashed_gaussian(mean, log_std, noise)
        return action, log_prob.squeeze(-1)

    @torch.no_grad()
    def value(self, obs: Tensor, action: Tensor) -> Tensor:
        """The lower of both critics' Q_k(s, a) for obs (B, O) and action (B, A): (B,)."""
        return self._heads(obs, action).amin(0)

    def value_gradient(self, obs: Tensor) -> Tensor:
        """dV_k/ds of both critics' V_k(s) = Q_k(s, mean action(s)) at obs (B, O): (2, B, O)."""
        state = obs.detach().clone().requires_grad_(True)
        q = self._heads(state, torch.tanh(self.gaussian(state)[0]))  # (2, B)
        heads = [torch.autograd.grad(q[k].sum(), state, retain_graph=k == 0)[0] for k in (0, 1)]
        return torch.stack(heads)

    def _heads(self, obs: Tensor, action: Tensor) -> Tensor:
        x = torch.cat([obs, action], -1)
        return torch.stack([self._critic.member(k, x).squeeze(-1) for k in (0, 1)])


def _gaussian(output: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and log_std of the actor's output (..., 2 A)."""
    mean, log_std = output.chunk(2, -1)
    return mean, log_std.clamp(LOG_STD_MIN, LOG_STD_MAX)


def _twin_inputs(obs: Tensor, action: Tensor) -> Tensor:
    """The inputs of both critics, (2, B, O + A)."""
    return torch.cat([obs, action], -1).repeat(2, 1, 1)
