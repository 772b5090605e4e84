"""Road-and-rocks: offline data, and policies driven in the real task."""

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from tom.config import RoadConfig
from tom.data.transitions import TensorTransitions
from tom.events import Episode
from tom.rng import Streams
from tom.road import task
from tom.road.task import RoadMap

EXPERT_NOISE = 0.4
"""standard deviation of the action noise on demonstrations"""
WALK_STEPS = 20

Steering = Callable[[Tensor], Tensor]
"""Actions (B, 2) for positions (B, 2)."""


def transition(obs: Tensor, action: Tensor, next_obs: Tensor) -> TensorTransitions:
    """The transitions (B,) of real or modelled steps, with the task's reward and goal."""
    terminated = task.at_goal(next_obs).float()
    reward = task.reward(next_obs)
    return TensorTransitions(
        obs, action, reward, next_obs, terminated, torch.zeros_like(terminated)
    )


def random_walks(road_map: RoadMap, rows: int, generator: torch.Generator) -> TensorTransitions:
    """`rows` transitions of walks of 20 uniform actions from uniform starts, in order.

    A walk that reaches the goal continues from a new start; its last step is truncated.
    """
    walks = -(-rows // WALK_STEPS)
    obs = torch.rand(walks, task.OBS_DIM, generator=generator)
    steps = []
    for _ in range(WALK_STEPS):
        action = 2 * torch.rand(walks, task.ACTION_DIM, generator=generator) - 1
        row = transition(obs, action, task.step(road_map, obs, action, generator))
        steps.append(row)
        fresh = torch.rand(walks, task.OBS_DIM, generator=generator)
        obs = torch.where(row.terminated[:, None] > 0, fresh, row.next_obs)
    steps[-1].truncated.copy_(1 - steps[-1].terminated)
    names = TensorTransitions.__dataclass_fields__  # T batches (B, ...) to (B T, ...), by walk
    by_walk = (torch.stack([getattr(s, n) for s in steps], 1).flatten(0, 1) for n in names)
    cut = TensorTransitions(*by_walk)[:rows]
    cut.truncated[-1] = 1 - cut.terminated[-1]
    return cut


def noisy_expert(generator: torch.Generator) -> Steering:
    """The demonstrator: the expert's steering with bounded action noise."""

    def steer(obs: Tensor) -> Tensor:
        noise = EXPERT_NOISE * torch.randn(obs.shape, generator=generator)
        return (task.expert_aim(obs) + noise).clamp(-1, 1)

    return steer


def random_steering(generator: torch.Generator) -> Steering:
    """Uniform actions."""
    return lambda obs: 2 * torch.rand(obs.shape, generator=generator) - 1


@torch.no_grad()
def drive(
    road_map: RoadMap, steer: Steering, episodes: int, generator: torch.Generator
) -> list[Episode]:
    """Episodes of a policy in the real task, in parallel, with at most 80 steps."""
    obs = [task.start_states(episodes, generator)]
    actions: list[Tensor] = []
    for _ in range(task.MAX_STEPS):
        actions.append(steer(obs[-1]))
        obs.append(task.step(road_map, obs[-1], actions[-1], generator))
    return [
        _episode(path, action)
        for path, action in zip(torch.stack(obs, 1), torch.stack(actions, 1), strict=True)
    ]


def _episode(path: Tensor, action: Tensor) -> Episode:
    """Cut the steps (T, 2) of one path (T + 1, 2) at the goal."""
    arrived = task.at_goal(path[1:])
    success = bool(arrived.any())
    length = int(arrived.float().argmax()) + 1 if success else len(action)
    return Episode(
        reward=task.reward(path[1 : length + 1]).numpy(),
        action=action[:length].numpy(),
        obs=path[: length + 1].numpy(),
        terminated=success,
        truncated=not success,
        info={"success": float(success)},
    )


def episode_rows(episode: Episode) -> TensorTransitions:
    """The transitions of one episode, in order."""
    obs, action = torch.from_numpy(episode.obs), torch.from_numpy(episode.action)
    rows = transition(obs[:-1], action, obs[1:])
    rows.truncated[-1] = float(episode.truncated)
    return rows


@dataclass(frozen=True)
class OfflineData:
    """A map and the data recorded on it, in the order of storage."""

    road_map: RoadMap
    rows: TensorTransitions  # N
    expert: Tensor  # (N,) bool: rows of the expert's trajectories
    footprint: Tensor  # (N,) bool: rows of the first of them, TOM's policy footprint
    demonstrations: list[Episode]  # the expert's trajectories


def map_of(config: RoadConfig) -> RoadMap:
    """The rocks of a run's map."""
    map_seed = config.seed if config.map_seed is None else config.map_seed
    return task.draw_map(config.turn, config.spread, Streams(map_seed).torch("road map"))


def collect(config: RoadConfig, streams: Streams) -> OfflineData:
    """The offline data of a run: random walks and a few expert trajectories."""
    road_map = map_of(config)
    walks = random_walks(road_map, config.random_transitions, streams.torch("walks"))
    generator = streams.torch("demonstrations")
    shown = drive(road_map, noisy_expert(generator), config.expert_trajectories, generator)
    expert = TensorTransitions.join([episode_rows(episode) for episode in shown])
    parts = [expert, walks] if config.expert_first else [walks, expert]
    first = 0 if config.expert_first else len(walks)
    row = torch.arange(len(walks) + len(expert))
    return OfflineData(
        road_map=road_map,
        rows=TensorTransitions.join(parts),
        expert=(row >= first) & (row < first + len(expert)),
        footprint=(row >= first) & (row < first + shown[0].length),
        demonstrations=shown,
    )
