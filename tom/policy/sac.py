"""Soft actor-critic (Haarnoja et al. 2018) with a learnt temperature, for M members at once.

Everything has a leading member axis M; a member is one seed of one learner. Members share neither
parameters nor random numbers, so each trains as it would alone.
"""

from collections.abc import Callable, Sequence
from copy import copy, deepcopy
from math import log
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import relu, softplus

from tom.config import SacConfig
from tom.data.transitions import TensorTransitions
from tom.nn.adam import Adam
from tom.nn.backprop import forward_trace, gradients, input_gradient
from tom.nn.mlp import StackedMLP, share
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

    capture: Callable[..., Any] | None = None

    def __init__(
        self, obs_dim: int, action_dim: int, config: SacConfig, generators: Generators
    ) -> None:
        members, hidden = len(generators), [config.hidden] * config.layers
        self.config = config
        self.dims = obs_dim, action_dim
        self.generators = generators
        self.target_entropy = (
            float(-action_dim) if config.target_entropy is None else config.target_entropy
        )
        self.actor = StackedMLP(members, [obs_dim, *hidden, 2 * action_dim], relu, generators)
        self.critic = StackedMLP(2 * members, [obs_dim + action_dim, *hidden, 1], relu, generators)
        self.target_critic = deepcopy(self.critic)
        for net in (self.actor, self.critic, self.target_critic):
            net.requires_grad_(False)
        self.log_temperature = torch.full(
            (members,), log(config.initial_temperature), device=generators[0].device
        )
        self.actor_optimiser = Adam(self.actor.tensors(), config.lr)
        self.critic_optimiser = Adam(self.critic.tensors(), config.lr)
        self.temperature_optimiser = Adam([self.log_temperature], config.lr)
        self._critics = self.critic.tensors(), self.target_critic.tensors()

    @property
    def device(self) -> torch.device:
        return self.log_temperature.device

    @classmethod
    def joined(cls, members: "Sequence[Sac]") -> "Sac":
        """All members' SACs as one; each stays valid, its tensors become views of this one's."""
        joint = copy(members[0])
        joint.generators = [g for one in members for g in one.generators]
        for name in ("actor", "critic", "target_critic"):
            setattr(joint, name, StackedMLP.joined([getattr(one, name) for one in members]))
        joint.log_temperature = share([one.log_temperature for one in members])
        for name in ("actor_optimiser", "critic_optimiser", "temperature_optimiser"):
            setattr(joint, name, Adam.joined([getattr(one, name) for one in members]))
        joint._critics = joint.critic.tensors(), joint.target_critic.tensors()
        return joint

    def update(self, batch: TensorTransitions) -> dict[str, Tensor]:
        """One gradient step of critics, actor and temperature on a (M, B, ...) batch.

        Returns its metrics, (M,) each.
        """
        return self.updates(batch.packed()[None])

    @torch.no_grad()
    def updates(
        self, batches: Tensor, step: Callable[..., "SacStep"] | None = None
    ) -> dict[str, Tensor]:
        """G gradient steps on packed transitions (G, M, B, R); the last one's metrics, (M,).

        `step` is this object's own, or its captured form.
        """
        shape = (len(batches), 2, batches.shape[2], self.dims[1])
        noise = normal(self.generators, shape).movedim(0, 2)  # (G, 2, M, B, A)
        take = step or self.step
        steps = [take(*drawn) for drawn in zip(batches, noise, strict=True)]
        return {**steps[-1].metrics(), "temperature/value": self.log_temperature.exp()}

    def step(self, rows: Tensor, noise: Tensor) -> "SacStep":
        """A gradient step on packed transitions (M, B, R) with normal draws (2, M, B, A).

        Gradients are written out by hand (see `backprop`): on a GPU this whole step is one graph.
        """
        batch = TensorTransitions.unpack(rows, *self.dims)
        critic_gradients, error, q = self.critic_gradients(batch, noise[0])
        self.critic_optimiser.step(critic_gradients)
        actor_gradients, loss, log_prob = self.actor_gradients(batch.obs, noise[1])
        self.actor_optimiser.step(actor_gradients)
        # d/d log_temperature of -log_temperature * (log_prob + target_entropy)
        self.temperature_optimiser.step([-(log_prob.mean(1) + self.target_entropy)])
        critics, targets = self._critics
        torch._foreach_lerp_(targets, critics, self.config.tau)  # pyright: ignore[reportPrivateImportUsage]
        return SacStep(error, q, loss, log_prob)

    def critic_target(self, batch: TensorTransitions, noise: Tensor) -> Tensor:
        """r + g (1 - terminated) (min_k Q'_k(s', a') - temperature log pi(a'|s')), (M, B).

        Bootstraps through truncation, never through termination.
        """
        mean, log_std = self._gaussian(forward_trace(self.actor, batch.next_obs).output)
        action, log_prob = squashed_gaussian(mean, log_std, noise)
        inputs = self._twin_inputs(batch.next_obs, action)
        next_q = _twins(forward_trace(self.target_critic, inputs).output)
        soft_value = torch.minimum(*next_q.unbind(1)) - self._temperature() * log_prob.squeeze(-1)
        return batch.reward + self.config.discount * (1.0 - batch.terminated) * soft_value

    def critic_gradients(
        self, batch: TensorTransitions, noise: Tensor
    ) -> tuple[list[Tensor], Tensor, Tensor]:
        """Gradients of sum_k E[(Q_k(s, a) - target)^2]; the errors and Q_k(s, a), (M, 2, B)."""
        target = self.critic_target(batch, noise)
        trace = forward_trace(self.critic, self._twin_inputs(batch.obs, batch.action))
        q = _twins(trace.output)
        error = q - target.unsqueeze(1)
        grad = error * (2.0 / error.shape[-1])
        return gradients(self.critic, trace, grad.flatten(0, 1).unsqueeze(-1)), error, q

    def actor_gradients(self, obs: Tensor, noise: Tensor) -> tuple[list[Tensor], Tensor, Tensor]:
        """Gradients of E[temperature log pi(a|s) - min_k Q_k(s, a)]; its terms, log pi, (M, B)."""
        trace = forward_trace(self.actor, obs)
        mean, log_std = self._gaussian(trace.output)
        action, log_prob = squashed_gaussian(mean, log_std, noise)
        q_trace = forward_trace(self.critic, self._twin_inputs(obs, action))
        first, second = _twins(q_trace.output).unbind(1)
        q, first_is_lower = torch.minimum(first, second), first <= second  # (M, B)

        # -1/B flows into the lower of the two critics, and on to the action.
        grad_q = torch.stack([first_is_lower, ~first_is_lower], 1) * (-1.0 / q.shape[-1])
        grad_input = input_gradient(self.critic, q_trace, grad_q.flatten(0, 1).unsqueeze(-1))
        grad_action = _twins(grad_input)[..., obs.shape[-1] :].sum(1)
        # a = tanh(u), u = mean + std noise: da/du = 1 - a^2, d log_prob/du = 2 a, and log_std
        # also stands in log_prob itself, with slope -1.
        temperature = self._temperature()
        share = temperature.unsqueeze(-1) / q.shape[-1]
        grad_u = grad_action * (1.0 - action.square()) + 2.0 * share * action
        grad_log_std = grad_u * log_std.exp() * noise - share
        grad_log_std.mul_(trace.output.chunk(2, -1)[1] == log_std)  # nothing flows where clamped
        actor_gradients = gradients(self.actor, trace, torch.cat([grad_u, grad_log_std], -1))
        log_prob = log_prob.squeeze(-1)
        return actor_gradients, temperature * log_prob - q, log_prob

    # Acting

    @torch.no_grad()
    def act(self, obs: Tensor, generators: Generators) -> Tensor:
        """Sampled actions for obs (M, B, O): (M, B, A)."""
        mean, log_std = self._gaussian(self.actor(obs))
        noise = normal(generators, mean.shape[1:])
        return torch.tanh(mean + log_std.exp() * noise)

    def member(self, index: int = 0) -> "MemberPolicy":
        """Member `index` alone, without the member axis."""
        return MemberPolicy(self.actor, self.critic, index)

    # Parts

    def _gaussian(self, output: Tensor) -> tuple[Tensor, Tensor]:
        mean, log_std = output.chunk(2, -1)
        return mean, log_std.clamp(LOG_STD_MIN, LOG_STD_MAX)

    def _temperature(self) -> Tensor:
        return self.log_temperature.exp().unsqueeze(-1)  # (M, 1)

    def _twin_inputs(self, obs: Tensor, action: Tensor) -> Tensor:
        """The inputs of both critics, (2 M, B, O + A)."""
        return torch.cat([obs, action], -1).repeat_interleave(2, 0)

    def state_dict(self) -> dict[str, Any]:
        return {
            "actor": self.actor.own_state(),
            "critic": self.critic.own_state(),
            "target_critic": self.target_critic.own_state(),
            "log_temperature": self.log_temperature.clone(),
            "actor_optimiser": self.actor_optimiser.state_dict(),
            "critic_optimiser": self.critic_optimiser.state_dict(),
            "temperature_optimiser": self.temperature_optimiser.state_dict(),
        }

    def load_state_dict(self, state: dict[str, Any]) -> None:
        for name in ("actor", "critic", "target_critic"):
            getattr(self, name).load_state_dict(state[name])
        for name in ("actor_optimiser", "critic_optimiser", "temperature_optimiser"):
            getattr(self, name).load_state_dict(state[name])
        self.log_temperature.copy_(state["log_temperature"])


class SacStep(NamedTuple):
    """The values of a gradient step, reduced to metrics only on request."""

    critic_error: Tensor  # (M, 2, B)
    critic_q: Tensor  # (M, 2, B)
    actor_loss: Tensor  # (M, B)
    log_prob: Tensor  # (M, B)

    def metrics(self) -> dict[str, Tensor]:
        return {
            "critic/loss": self.critic_error.square().mean(-1).sum(1),
            "critic/q": self.critic_q.mean((1, 2)),
            "actor/loss": self.actor_loss.mean(1),
            "actor/entropy": -self.log_prob.mean(1),
        }


class GaussianPolicy:
    """Network `index` of an actor as a policy (`tom.learners.base.Policy`)."""

    def __init__(self, actor: StackedMLP, index: int) -> None:
        self._actor = actor
        self._index = index

    @torch.no_grad()
    def __call__(self, obs: Tensor, n: int, generator: torch.Generator) -> Tensor:
        """n sampled actions for obs (B, O): (n, B, A)."""
        mean, log_std = self._gaussian(obs)
        noise = torch.randn(n, *mean.shape, generator=generator, device=generator.device)
        return torch.tanh(mean + log_std.exp() * noise)

    @torch.no_grad()
    def mean(self, obs: Tensor) -> Tensor:
        """Mean actions for obs (B, O): (B, A)."""
        return torch.tanh(self._gaussian(obs)[0])

    def _gaussian(self, obs: Tensor) -> tuple[Tensor, Tensor]:
        obs = obs.to(self._actor.layers[0][0].device)
        mean, log_std = self._actor.member(self._index, obs).chunk(2, -1)
        return mean, log_std.clamp(LOG_STD_MIN, LOG_STD_MAX)


class MemberPolicy(GaussianPolicy):
    """One member of a SAC: its policy and its value heads, networks 2 i and 2 i + 1 of `critic`."""

    def __init__(self, actor: StackedMLP, critic: StackedMLP, index: int) -> None:
        super().__init__(actor, index)
        self._critic = critic

    @torch.no_grad()
    def draw(self, obs: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """A sampled action (B, A) for each of obs (B, O), and its log_prob (B,)."""
        mean, log_std = self._gaussian(obs)
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
        q = self._values(state)  # (2, B)
        heads = [torch.autograd.grad(q[k].sum(), state, retain_graph=k == 0)[0] for k in (0, 1)]
        return torch.stack(heads)

    def _values(self, obs: Tensor) -> Tensor:
        return self._heads(obs, torch.tanh(self._gaussian(obs)[0]))

    def _heads(self, obs: Tensor, action: Tensor) -> Tensor:
        x = torch.cat([obs, action], -1)
        heads = [self._critic.member(2 * self._index + k, x).squeeze(-1) for k in (0, 1)]
        return torch.stack(heads)


def _twins(x: Tensor) -> Tensor:
    """(2 M, B, D) -> (M, 2, B, D); a D of one is dropped."""
    return x.unflatten(0, (-1, 2)).squeeze(-1)
