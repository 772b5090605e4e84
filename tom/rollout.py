"""Rollouts of the policy in the learnt model: what SAC trains on."""

from collections.abc import Callable
from typing import Protocol

import torch
from torch import Tensor

from tom.config import RolloutConfig
from tom.data.replay import ReplayBuffer
from tom.data.sampling import WeightedSampler, uniform_indices
from tom.data.transitions import TensorTransitions
from tom.learners.base import Policy

Termination = Callable[[Tensor], Tensor]  # next_obs (B, O) -> terminated (B,)

EXPLODED = 100.0
"""a modelled state this many times beyond the largest start state has exploded"""


class Simulator(Protocol):
    """What a rollout needs of a dynamics model."""

    def sample(
        self, obs: Tensor, action: Tensor, generator: torch.Generator
    ) -> tuple[Tensor, Tensor]:
        """Draw (reward (B,), next_obs (B, O)) for obs (B, O) and action (B, A)."""
        ...


def start_states(
    replay: TensorTransitions, weights: Tensor | None, n: int, generator: torch.Generator
) -> Tensor:
    """n states of the replay buffer, (n, O): by weight (N,), or uniformly without weights."""
    if weights is None:
        return replay.obs[uniform_indices(len(replay), n, generator)]
    return replay.obs[WeightedSampler(weights, generator).draw(n)]


@torch.no_grad()
def roll_out(
    model: Simulator,
    policy: Policy,
    terminated: Termination,
    starts: Tensor,
    length: int,
    config: RolloutConfig,
    model_buffer: ReplayBuffer,
    generator: torch.Generator,
) -> dict[str, float]:
    """Play `length` steps of `policy` in `model` from `starts` (B, O) into the model buffer.

    A rollout ends where `terminated` says so, or where the model's prediction is not finite.
    Rows are predicted in chunks that stay in the processor's cache.
    """
    reward_sum, ended, steps, diverged, exploded = 0.0, 0, 0, 0, 0
    far = EXPLODED * starts.abs().amax()
    for chunk in starts.split(config.chunk):
        obs = chunk
        for _ in range(length):
            action = policy(obs, 1, generator)[0]
            reward, next_obs = model.sample(obs, action, generator)
            finite = next_obs.isfinite().all(-1) & reward.isfinite()
            if not bool(finite.all()):
                diverged += int((~finite).sum())
                obs, action, reward = obs[finite], action[finite], reward[finite]
                next_obs = next_obs[finite]
            end = terminated(next_obs)
            flags = end.to(torch.float32)
            model_buffer.extend(
                TensorTransitions(obs, action, reward, next_obs, flags, torch.zeros_like(flags))
            )
            reward_sum += float(reward.sum())
            ended += int(end.sum())
            steps += len(obs)
            exploded += int((next_obs.abs().amax(-1) > far).sum())
            obs = next_obs[~end]
            if not len(obs):
                break
    return {
        "rollout/reward": reward_sum / max(steps, 1),
        "rollout/terminated": ended / max(steps, 1),
        "rollout/diverged": diverged / max(steps + diverged, 1),
        "rollout/exploded": exploded / max(steps, 1),
    }
