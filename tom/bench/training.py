"""The cost of a whole env step of the paper's Hopper training, and the memory of a large buffer."""

import resource
import tempfile
from pathlib import Path
from time import process_time

import torch

from tom.bench.parts import model_flops, rollout_flops, sac_flops
from tom.config import OnlineConfig
from tom.data.replay import ReplayBuffer
from tom.data.transitions import TensorTransitions
from tom.dynamics import make_model
from tom.envs import task
from tom.events import Event, Metrics
from tom.mbpo import Mbpo
from tom.record import Store
from tom.training.presets import resolve
from tom.training.run import train

CYCLE = 250  # env steps from one model fit to the next
EXPLORE = 1000
AUTHORS_MS = 106.0
"""an env step of the authors' code, mean of the first 1000, one core with 107 GFLOP/s (MKL)"""


def config_of(steps: int) -> OnlineConfig:
    """The paper's Hopper with TOM, `steps` env steps after a shorter exploration."""
    changes = {"exploration_steps": EXPLORE, "steps": EXPLORE + steps}
    config = resolve("hopper", "tom", "paper", changes)
    assert isinstance(config, OnlineConfig)
    return config


def cycle_s() -> float:
    """CPU seconds of one model fit, its rollouts and 250 env steps, before TOM starts to weigh.

    This is the cheapest part of a training: the buffer is small and there is no dual Q yet.
    """
    begun = process_time()
    for event in Mbpo(config_of(CYCLE)).events():
        if event.env_step < EXPLORE:
            begun = process_time()
    return process_time() - begun


def step_ms(steps: int = 1000) -> tuple[float, float]:
    """CPU milliseconds of an env step, and the GFLOP of its matrix products.

    Model fits, rollouts, SAC, env, evaluation and recording, before TOM starts to weigh.
    """
    config, rounds, begun = config_of(steps), [], process_time()

    def watch(event: Event) -> None:
        nonlocal begun
        if event.env_step < EXPLORE:
            begun = process_time()
        if isinstance(event, Metrics) and "model/rounds" in event.values:
            rounds.append(event.values["model/rounds"])

    with tempfile.TemporaryDirectory() as scratch:
        train(config, Store(Path(scratch)), rerun=False, watchers=(watch,))
    spent = process_time() - begun
    flops = steps * config.updates_per_step * sac_flops(config.sac)
    flops += sum(rounds) * config.model.batches_per_round * model_flops(config.model)
    flops += len(rounds) * config.rollout.starts * rollout_flops(config.model, config.sac)
    return spent * 1000 / steps, flops / steps / 1e9


def buffer_memory(rows: int = 1_000_000) -> tuple[float, float]:
    """Peak GB of this process with a full Humanoid buffer, before and after a (short) fit."""
    humanoid = task("humanoid")
    obs, action = humanoid.obs_dim, humanoid.action_dim
    buffer = ReplayBuffer(rows, obs, action)
    generator = torch.Generator().manual_seed(0)
    for _ in range(rows // 10_000):
        part = torch.randn(10_000, 2 * obs + action + 3, generator=generator)
        buffer.extend(TensorTransitions.unpack(part, obs, action))
    filled = _peak_gb()
    config = resolve("humanoid", "tom", "paper", {"model": {"rounds": 1, "batches_per_round": 10}})
    assert isinstance(config, OnlineConfig)
    model = make_model(obs, action, config.model, generator)
    model.fit(buffer.transitions(), torch.ones(len(buffer)), None, generator)
    return filled, _peak_gb()


def _peak_gb() -> float:
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
