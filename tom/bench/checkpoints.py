"""The cost of a checkpoint: its size, its time, and its share of the training time."""

import tempfile
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter

import torch

from tom.config import OnlineConfig
from tom.data.transitions import TensorTransitions
from tom.mbpo import Mbpo
from tom.record import checkpoint
from tom.training.presets import resolve

REPEATS = 3
CYCLE = 250  # env steps between two checkpoints whose training time is measured


@dataclass(frozen=True)
class CheckpointCost:
    """One checkpoint with full buffers; at most three are on the disk at a time."""

    run: str
    megabytes: float
    megabytes_at_most: float
    ms: float
    share_percent: float | None


def checkpoint_costs(train_s: float) -> list[CheckpointCost]:
    """The costs for Hopper and Humanoid; `train_s` is the time of 250 training steps of Hopper."""
    return [_cost(env, train_s if env == "hopper" else None) for env in ("hopper", "humanoid")]


def _cost(env: str, train_s: float | None) -> CheckpointCost:
    config = resolve(env, "tom", "paper")
    assert isinstance(config, OnlineConfig)
    training = _full(config)
    with tempfile.TemporaryDirectory() as folder:
        times, size = [], 0.0
        for step in range(REPEATS):
            begun = perf_counter()
            path = checkpoint.save(Path(folder), step, {"training": training.state_dict()})
            times.append(perf_counter() - begun)
            size = (path / checkpoint.STATE).stat().st_size / 1e6
    seconds = sorted(times)[REPEATS // 2]
    between = None if train_s is None else train_s * config.checkpoint_every / CYCLE
    share = None if between is None else 100 * seconds / between
    most = size * (checkpoint.KEPT + 1)
    return CheckpointCost(f"{env} tom {config.preset}", size, most, 1e3 * seconds, share)


def _full(config: OnlineConfig) -> Mbpo:
    """A training whose model buffer is full."""
    training = Mbpo(config)
    for _ in training.step_environment(explore=True):
        pass
    dims = (training.task.obs_dim, training.task.action_dim)
    training.model_buffer.extend(_rows(training.model_buffer.capacity, *dims))
    return training


def _rows(n: int, obs: int, action: int) -> TensorTransitions:
    flat = torch.rand(n)
    wide = torch.rand(n, obs)
    return TensorTransitions(wide, torch.rand(n, action), flat, wide, flat.round(), flat.round())
