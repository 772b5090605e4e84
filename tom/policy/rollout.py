"""Rollouts of the policy in the learnt model, and SAC's minibatches of them and real rows."""

import torch
from torch import Tensor

from tom.config import RolloutConfig
from tom.data.replay import ReplayBuffer
from tom.data.sampling import WeightedSampler, uniform_indices
from tom.data.transitions import TensorTransitions
from tom.dynamics.base import Sampled
from tom.envs.task import Termination
from tom.learners.base import Policy
from tom.nn.mlp import rows_at_once

EXPLODED = 100.0
"""a modelled state has exploded if it is this many times larger than the largest start state"""


def start_states(
    replay: TensorTransitions, weights: Tensor | None, n: int, generator: torch.Generator
) -> Tensor:
    """Draw n states of the replay buffer, (n, O): by weights (N,), or uniformly if None."""
    if weights is None:
        return replay.obs[uniform_indices(len(replay), n, generator)]
    return replay.obs[WeightedSampler(weights, generator).draw(n)]


@torch.no_grad()
def roll_out(
    model: Sampled,
    policy: Policy,
    terminated: Termination,
    starts: Tensor,
    length: int,
    config: RolloutConfig,
    model_buffer: ReplayBuffer,
    generator: torch.Generator,
) -> dict[str, float]:
    """Play `length` steps of `policy` in `model` from `starts` (B, O) into the model buffer.

    A rollout ends if `terminated` is true or the model's prediction is not finite. Rows are
    predicted in chunks that stay in the processor's cache. On a GPU each chunk and step costs one
    host read to check that all is finite, and one more, except at the last step, for the ends.
    """
    far = EXPLODED * starts.abs().amax()
    steps, diverged = 0, 0
    seen: list[Tensor] = []  # rewards, ends and explosions of each chunk; fetched at the end
    for chunk in starts.split(rows_at_once(starts.device, config.chunk)):
        obs = chunk
        for step in range(length):
            action = policy(obs, 1, generator)[0]
            reward, next_obs = model.sample(obs, action, generator)
            if not bool((next_obs.sum() + reward.sum()).isfinite()):  # a sum over NaN or inf
                finite = next_obs.isfinite().all(-1) & reward.isfinite()
                diverged += len(obs) - int(finite.sum())
                obs, action, reward, next_obs = (x[finite] for x in (obs, action, reward, next_obs))
            end = terminated(next_obs).to(torch.float32)
            rows = TensorTransitions(obs, action, reward, next_obs, end, torch.zeros_like(end))
            model_buffer.extend(rows)
            beyond = (next_obs.abs().amax(-1) > far).to(torch.float32)
            seen.append(torch.stack([reward.sum(), end.sum(), beyond.sum()]))
            steps += len(rows)
            if step == length - 1:
                break  # who goes on is not asked, which spares a GPU one host read
            obs = next_obs[end == 0]
            if not len(obs):
                break
    reward_sum, ended, exploded = map(sum, zip(*torch.stack(seen).tolist(), strict=True))
    return {
        "rollout/reward": reward_sum / max(steps, 1),
        "rollout/terminated": ended / max(steps, 1),
        "rollout/diverged": diverged / max(steps + diverged, 1),
        "rollout/exploded": exploded / max(steps, 1),
    }


def mixed_batches(
    real: ReplayBuffer,
    modelled: ReplayBuffer,
    updates: int,
    size: int,
    real_ratio: float,
    generator: torch.Generator,
) -> Tensor:
    """Packed minibatches (G, B, R), drawn uniformly: a share of real rows, then modelled ones."""
    n = int(real_ratio * size)
    real_rows = uniform_indices(len(real), updates * n, generator)
    modelled_rows = uniform_indices(len(modelled), updates * (size - n), generator)
    real_part = real.packed(real_rows).unflatten(0, (updates, n))
    modelled_part = modelled.packed(modelled_rows).unflatten(0, (updates, size - n))
    return torch.cat([real_part, modelled_part], 1)
