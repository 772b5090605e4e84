"""Small buffers and contexts for the learners' tests: made, not mocked."""

from collections.abc import Callable
from dataclasses import replace

import torch
from common import generator
from torch import Tensor

from tom.config import TomConfig
from tom.data.transitions import TensorTransitions
from tom.learners.base import FitContext, Policy

OBS, ACTION = 3, 2

QUICK = TomConfig(
    discriminator_steps=60, q_steps=60, q_hidden=32, discriminator_hidden=32, action_samples=2
)


def rows(n: int, seed: int = 0, shift: float = 0.0) -> TensorTransitions:
    """Unit normal observations around `shift`, small steps, no episode end."""
    g = generator(seed)
    obs = torch.randn(n, OBS, generator=g) + shift
    action = torch.rand(n, ACTION, generator=g) * 2 - 1
    step = 0.1 * torch.randn(n, OBS, generator=g)
    zeros = torch.zeros(n)
    return TensorTransitions(obs, action, zeros, obs + step, zeros, zeros)


def ended(batch: TensorTransitions, flag: str) -> TensorTransitions:
    """The same rows, every one an end of the given kind."""
    return replace(batch, **{flag: torch.ones(len(batch))})


def uniform_policy(obs: Tensor, n: int, generator: torch.Generator) -> Tensor:
    return torch.rand(n, len(obs), ACTION, generator=generator) * 2 - 1


class LinearGaussian:
    """A policy whose mean before tanh is the first observations."""

    def gaussian(self, obs: Tensor) -> tuple[Tensor, Tensor]:
        mean = obs[:, :ACTION]
        return mean, torch.full_like(mean, -1.0)

    def __call__(self, obs: Tensor, n: int, generator: torch.Generator) -> Tensor:
        mean, log_std = self.gaussian(obs)
        noise = torch.randn(n, *mean.shape, generator=generator)
        return torch.tanh(mean + log_std.exp() * noise)


def context(
    replay: TensorTransitions,
    policy_buffer: TensorTransitions | None = None,
    policy_version: Tensor | None = None,
    value_gradient: Callable[[Tensor], Tensor] | None = None,
    behaviour: Tensor | None = None,
    model_errors: Callable[[], Tensor] | None = None,
    policy: Policy = uniform_policy,
    seed: int = 0,
) -> FitContext:
    n = len(replay)
    return FitContext(
        replay=replay,
        policy_version=torch.zeros(n, dtype=torch.int64)
        if policy_version is None
        else policy_version,
        policy_buffer=replay[: n // 10] if policy_buffer is None else policy_buffer,
        on_policy_steps=10_000,
        initial_obs=replay.obs[:20],
        policy=policy,
        generator=generator(seed),
        value_gradient=value_gradient,
        behaviour=behaviour,
        model_errors=model_errors,
    )
