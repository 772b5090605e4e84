"""Wall-clock time of a fleet's steps on a device, for Hopper with the preset `paper`.

Each part runs through `Lockstep`, as in a training: joined, and on a GPU captured.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from statistics import median
from time import perf_counter

import numpy as np
import torch

from tom.bench.parts import ACTION, BATCH, OBS, transitions
from tom.config import ModelConfig, OnlineConfig, RolloutConfig, SacConfig, TomConfig
from tom.data.replay import ReplayBuffer
from tom.data.transitions import TensorTransitions
from tom.dynamics import make_model
from tom.dynamics.fitting import Fit
from tom.envs import task
from tom.learners.base import FitContext
from tom.learners.tom import TomLearner
from tom.nn.lockstep import Call, Lockstep
from tom.policy.rollout import roll_out
from tom.policy.sac import Sac
from tom.policy.sac_work import SacUpdates
from tom.training.presets import resolve

PAPER = TomConfig.preset("paper").but(warmup=1)
WARM = 2  # repeats that are not counted, because of captures, allocators and first kernels
UPDATES = 5
EAGER, ALONE = "SAC update, one alone, eager", "SAC update, one alone"
SAC, MDN, WEIGHTS = "SAC update", "MDN step in a fit", "TOM's weights"
ROLLOUT, ENV, ADD = "rollout of one member", "env step", "transition into the buffer"
TARGETS = {SAC: "a GPU: >= 1 500 a second with 20 members", ALONE: "a GPU: >= 5 times the eager"}


@dataclass(frozen=True)
class Sizes:
    """How many units of each part one repeat does."""

    updates: int = 20
    mdn_steps: int = 100
    tom: TomConfig = PAPER
    rows: int = 60_000
    """rows of the replay buffer: its mean size over 125 000 env steps"""
    starts: int = RolloutConfig().starts


@dataclass(frozen=True)
class Measured:
    """Wall milliseconds of a part for all members together, and the units per second."""

    part: str
    members: int
    ms: float
    low_ms: float
    high_ms: float
    per_second: float
    member_per_second: float
    target: str | None


@dataclass(frozen=True)
class _Part:
    name: str
    members: int
    units: int
    run: Callable[[], object]


def measure(
    device: torch.device, members: int, repeats: int, sizes: Sizes | None = None
) -> list[Measured]:
    """Time every part for a fleet of `members` members, with interleaved repeats."""
    parts = list(_parts(device, members, sizes or Sizes()))
    seconds: dict[str, list[float]] = {part.name: [] for part in parts}
    for repeat in range(WARM + repeats):
        for part in parts:
            start = perf_counter()
            part.run()
            if device.type == "cuda":
                torch.cuda.synchronize(device)
            if repeat >= WARM:
                seconds[part.name].append((perf_counter() - start) / part.units)
    return [_measured(part, seconds[part.name]) for part in parts]


def minutes(rows: Sequence[Measured]) -> float:
    """Minutes that this fleet needs for the paper's Hopper with TOM, if every fit uses all rounds.

    Evaluation, recording and the drawing of minibatches are not included.
    """
    ms = {row.part: row.ms for row in rows}
    members = max(row.members for row in rows)
    config = resolve("hopper", "tom", "paper")
    assert isinstance(config, OnlineConfig)
    fit = config.model.rounds * config.model.batches_per_round * ms[MDN]
    fit += ms[WEIGHTS] + members * ms[ROLLOUT]
    step = config.updates_per_step * ms[SAC] + ms[ENV] + ms[ADD] + fit / config.fit_every
    return (config.steps - config.exploration_steps) * step / 60_000


def _measured(part: _Part, seconds: Sequence[float]) -> Measured:
    middle = median(seconds)
    return Measured(
        part.name,
        part.members,
        middle * 1e3,
        min(seconds) * 1e3,
        max(seconds) * 1e3,
        1 / middle,
        part.members / middle,
        TARGETS.get(part.name),
    )


def _parts(device: torch.device, members: int, sizes: Sizes) -> Iterator[_Part]:
    rounds = max(sizes.updates // UPDATES, 1)
    eager = _sac(device, 0)
    batches = transitions(BATCH).packed().to(device).expand(UPDATES, -1, -1).contiguous()
    yield _Part(
        EAGER, 1, rounds * UPDATES, lambda: [eager.updates(batches[:, None]) for _ in range(rounds)]
    )
    for name, count in ((ALONE, 1), (SAC, members)):
        works = [SacUpdates(_sac(device, seed), batches) for seed in range(count)]
        yield _Part(name, count, rounds * UPDATES, _again(partial(Lockstep().do, works), rounds))
    yield _mdn(device, members, sizes)
    yield _weights(device, members, sizes)
    yield _rollout(device, sizes)
    yield _env(members)
    yield _add(device, members)


def _again(call: Callable[[], object], times: int) -> Callable[[], object]:
    return lambda: [call() for _ in range(times)]


def _generator(device: torch.device, seed: int) -> torch.Generator:
    return torch.Generator(device).manual_seed(seed)


def _sac(device: torch.device, seed: int) -> Sac:
    return Sac(OBS, ACTION, SacConfig(), [_generator(device, seed)])


def _rows(device: torch.device, n: int) -> TensorTransitions:
    return TensorTransitions.unpack(transitions(n).packed().to(device), OBS, ACTION)


def _mdn(device: torch.device, members: int, sizes: Sizes) -> _Part:
    config = ModelConfig(rounds=1, batches_per_round=sizes.mdn_steps)
    data, lockstep = _rows(device, sizes.rows), Lockstep()
    weights = torch.ones(len(data), device=device)
    models = [make_model(OBS, ACTION, config, _generator(device, m)) for m in range(members)]
    works = [
        Fit(model, data, weights, None, _generator(device, 100 + m))  # pyright: ignore[reportArgumentType]
        for m, model in enumerate(models)
    ]
    return _Part(MDN, members, sizes.mdn_steps, lambda: lockstep.do(works))


def _weights(device: torch.device, members: int, sizes: Sizes) -> _Part:
    data = _rows(device, sizes.rows)

    def weigh() -> object:
        asked = zip(learners, map(context, range(members)), strict=True)
        return Lockstep().run([partial(learner.weigh, seen) for learner, seen in asked])

    def context(member: int) -> FitContext:
        return FitContext(
            replay=data,
            policy_version=torch.zeros(len(data), dtype=torch.int64, device=device),
            policy_buffer=data[-1000:],
            on_policy_steps=1000,
            initial_obs=data.obs[:100],
            policy=policies[member],
            generator=_generator(device, 200 + member),
        )

    policies = [_sac(device, m).member() for m in range(members)]
    learners = [
        TomLearner(sizes.tom, OBS, ACTION, _generator(device, 300 + m)) for m in range(members)
    ]
    return _Part(WEIGHTS, members, 1, weigh)


def _rollout(device: torch.device, sizes: Sizes) -> _Part:
    model = make_model(OBS, ACTION, ModelConfig(), _generator(device, 0))
    policy, config = _sac(device, 0).member(), RolloutConfig(starts=sizes.starts)
    buffer = ReplayBuffer(sizes.starts, OBS, ACTION, device)
    starts, generator = _rows(device, sizes.starts).obs, _generator(device, 1)
    ends = task("hopper").terminated
    return _Part(
        ROLLOUT,
        1,
        1,
        lambda: roll_out(model, policy, ends, starts, 1, config, buffer, generator),
    )


def _env(members: int) -> _Part:
    envs = [task("hopper").make() for _ in range(members)]
    for seed, env in enumerate(envs):
        env.reset(seed=seed)
    action, steps, lockstep = np.zeros(ACTION, np.float32), 20, Lockstep()

    def step() -> None:
        works = [Call(partial(env.step, action)) for env in envs]
        lockstep.do(works)
        for env, work in zip(envs, works, strict=True):
            if work.result()[2]:
                env.reset()

    return _Part(ENV, members, steps, _again(step, steps))


def _add(device: torch.device, members: int) -> _Part:
    buffers, steps = [ReplayBuffer(1000, OBS, ACTION, device) for _ in range(members)], 20
    obs, action = np.zeros(OBS, np.float32), np.zeros(ACTION, np.float32)

    def add() -> None:
        for buffer in buffers:
            buffer.add(obs, action, 1.0, obs, False, False)

    return _Part(ADD, members, steps, _again(add, steps))
