"""The cost of whole env steps, of their record and checkpoints, of many runs, of a large buffer.

What is recorded is like Hopper late in the paper's schedule: 100 000 weights at every fit, ten
evaluation episodes of 1 000 steps every 1 000 steps, 250 new rows of the buffer, 30 metrics.
"""

import os
import resource
import tempfile
from collections.abc import Callable, Iterable, Sequence
from itertools import count
from pathlib import Path
from statistics import median
from time import perf_counter, process_time
from typing import Any

import numpy as np
import torch

from tom.bench.timing import ACTION, OBS, model_flops, rollout_flops, sac_flops
from tom.config import OnlineConfig
from tom.data.replay import ReplayBuffer
from tom.data.transitions import TensorTransitions, Transitions
from tom.dynamics import make_model
from tom.envs import task
from tom.events import Collected, Episode, Evaluation, Event, Metrics, Tick, Weights
from tom.mbpo import Mbpo
from tom.metrics import METRICS
from tom.own_loop.run import record
from tom.record import Store, checkpoint, layout
from tom.record.recorder import Recorder
from tom.record.rerun.sink import RerunSink
from tom.record.writer import RunWriter
from tom.training.presets import resolve
from tom.training.run import train

CYCLE, CYCLES = 250, 20
"""env steps from one model fit to the next; so many of these are recorded"""
EXPLORE = 1000
AUTHORS_MS = 106.0
"""an env step of the authors' code, mean of the first 1000, one core with 107 GFLOP/s (MKL)"""
EVERY, STEPS, EPISODES = 1000, 1000, 10  # evaluations: env steps between, steps, episodes
WEIGHTS, METRICS_A_ROW = 100_000, 30
NQ = 6
REPEATS = 3  # of a checkpoint
RUNS, LISTING_TARGET_S = 1000, 2.0  # a week of sweeps

Row = dict[str, Any]
Events = Callable[[int], Iterable[Event]]
"""the events of the 250 steps that end with an env step"""


def paper(env: str, **changes: Any) -> OnlineConfig:
    config = resolve(env, "tom", "paper", changes)
    assert isinstance(config, OnlineConfig)
    return config


def step_ms(steps: int = 1000) -> tuple[float, float]:
    """CPU milliseconds of an env step, and the GFLOP of its matrix products.

    Model fits, rollouts, SAC, env, evaluation and recording, before TOM starts to weigh: the
    cheapest part of a training, because the buffer is small and there is no dual Q yet.
    """
    config = paper("hopper", exploration_steps=EXPLORE, steps=EXPLORE + steps)
    rounds, begun = [], process_time()

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
    filled = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6
    config = paper("humanoid", model={"rounds": 1, "batches_per_round": 10})
    model = make_model(obs, action, config.model, generator)
    model.fit(buffer.transitions(), torch.ones(len(buffer)), None, generator)
    return filled, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6


# Recording


def recording_costs(train_s: float) -> list[Row]:
    """CPU milliseconds for 250 env steps of each part and of all, without and with Rerun.

    Shares are relative to `train_s`, the CPU seconds of training for 250 env steps.
    """
    parts = _parts()
    with tempfile.TemporaryDirectory() as folder:
        store = Store(Path(folder))
        ms = {name: _record_ms(store, [part]) for name, part in parts.items()}
        ms["all files"] = _record_ms(store, parts.values())
        ms["all files and Rerun"] = _record_ms(store, parts.values(), rerun=True)
    return [{"part": k, "ms": v, "share_percent": v / train_s / 10} for k, v in ms.items()]


def record_run(store: Store) -> None:
    """Record CYCLES times 250 env steps into a new run, without Rerun."""
    _record_ms(store, _parts().values())


def _parts() -> dict[str, Events]:
    rng = np.random.default_rng(0)
    weight = rng.random(WEIGHTS, np.float32)
    values = {name: float(rng.random()) for name in list(METRICS)[:METRICS_A_ROW]}
    obs, next_obs = rng.random((2, CYCLE, OBS), np.float32)
    action, reward = rng.random((CYCLE, ACTION), np.float32), rng.random(CYCLE, np.float32)
    no, version = np.zeros(CYCLE, bool), np.zeros(CYCLE, np.int64)
    rows = Transitions(obs, action, reward, next_obs, no, no)
    qpos, qvel = rng.random((2, STEPS + 1, NQ), np.float32)
    played = Episode(
        reward=rng.random(STEPS, np.float32),
        action=rng.random((STEPS, ACTION), np.float32),
        obs=rng.random((STEPS + 1, OBS), np.float32),
        qpos=qpos,
        qvel=qvel,
    )
    return {
        "250 steps' ticks": lambda step: [Tick(s, "optimise") for s in range(step - CYCLE, step)],
        "a row of 30 metrics": lambda step: [Metrics(step, values), Tick(step, "optimise")],
        "profile and snapshot of 100k weights": lambda step: [Weights(step, weight)],
        "250 rows of the buffer": lambda step: [Collected(step, rows, version)],
        "10 episodes of 1000 steps / 4": lambda step: (
            [Evaluation(step, [played] * EPISODES)] if step % EVERY == 0 else []
        ),
    }


def _record_ms(store: Store, parts: Iterable[Events], *, rerun: bool = False) -> float:
    config = OnlineConfig(env="hopper", learner="tom", steps=CYCLE * CYCLES)
    writer, steps = RunWriter.create(store, None, config), range(CYCLE, config.steps + 1, CYCLE)
    given = [event for step in steps for part in parts for event in part(step)]
    recorder = Recorder(writer, RerunSink(writer.path) if rerun else None)
    begun = process_time()
    for event in given:
        recorder.consume(event)
    recorder.finish("finished")
    return (process_time() - begun) * 1e3 / CYCLES


def listing_cost(list_runs: Callable[[Path], object]) -> Row:
    """CPU and wall-clock seconds of `list_runs` on a store of RUNS runs; the target is for the CPU.

    The second call is timed, because the first one loads code.
    """
    with tempfile.TemporaryDirectory() as folder:
        store = make_store(Path(folder))
        list_runs(store)
        wall, cpu = perf_counter(), process_time()
        list_runs(store)
        wall_s, cpu_s = perf_counter() - wall, process_time() - cpu
    row = {"runs": RUNS, "cpu_s": cpu_s, "wall_s": wall_s, "target_s": LISTING_TARGET_S}
    return {**row, "met": cpu_s <= LISTING_TARGET_S}


def make_store(folder: Path, runs: int = RUNS) -> Path:
    """Make a store of `runs` run folders in `folder`: copies of one recorded run."""
    one, many = Store(folder / "one"), folder / "many"
    record_run(one)
    (run,) = one.runs()
    for number in range(runs):
        copy = many / f"run-{number:04d}"
        copy.mkdir(parents=True)
        for name in (layout.CONFIG, layout.STATUS, layout.METRICS):
            os.link(run.path / name, copy / name)
    return many


def checkpoint_cost(env: str, train_s: float | None) -> Row:
    """A checkpoint with full buffers; at most three are on the disk at a time.

    `train_s` is the time of 250 training steps.
    """
    config = paper(env)
    training = Mbpo(config)
    for _ in training.step_environment(explore=True):
        pass
    obs, action = training.task.obs_dim, training.task.action_dim
    n = training.model_buffer.capacity
    flat, wide = torch.rand(n), torch.rand(n, obs)
    rows = TensorTransitions(wide, torch.rand(n, action), flat, wide, flat.round(), flat.round())
    training.model_buffer.extend(rows)
    with tempfile.TemporaryDirectory() as folder:
        times, megabytes = [], 0.0
        for step in range(REPEATS):
            begun = perf_counter()
            path = checkpoint.save(Path(folder), step, {"training": training.state_dict()})
            times.append(perf_counter() - begun)
            megabytes = (path / checkpoint.STATE).stat().st_size / 1e6
    between_s = None if train_s is None else train_s * config.checkpoint_every / CYCLE
    return {
        "run": f"{env} tom {config.preset}",
        "megabytes": megabytes,
        "megabytes_at_most": megabytes * (checkpoint.KEPT + 1),
        "ms": 1e3 * median(times),
        "share_percent": None if between_s is None else 100 * median(times) / between_s,
    }


# A loop of the user's own

LOOP_ROWS, LOOP_BLOCK, LOOP_CALLS = 1_000_000, 1000, 20_000
Block = tuple[np.ndarray, ...]  # the columns of a loop's rows
STEP_MS = 10.0  # of the loop, of which recording may take 1 %


def loop_costs() -> list[Row]:
    """`tom.record` with Hopper's rows in double precision: calls of one step, and of blocks.

    A call is the median of 20 000; the target is 1 % of a step of 10 ms. Of 1 000 blocks of 1 000
    rows it is twice what `numpy.save` takes for the same arrays: CPU time, without `close`, which
    makes digests.
    """
    rng = np.random.default_rng(0)
    walk = rng.normal(size=(LOOP_ROWS + 1, OBS)).cumsum(0)
    action, reward = rng.uniform(-1, 1, (LOOP_ROWS, ACTION)), rng.normal(size=LOOP_ROWS)
    cut = np.arange(LOOP_ROWS) % STEPS == STEPS - 1
    columns = walk[:-1], action, reward, walk[1:], np.zeros(LOOP_ROWS, bool), cut
    parts = [slice(first, first + LOOP_BLOCK) for first in range(0, LOOP_ROWS, LOOP_BLOCK)]
    blocks = [tuple(column[part] for column in columns) for part in parts]
    with tempfile.TemporaryDirectory() as folder, record("a", env="Hopper-v5", store=folder) as run:
        recorded = _row_us(blocks, lambda block: run.transitions(*block))  # pyright: ignore
    with tempfile.TemporaryDirectory() as folder:
        names = (Path(folder) / str(number) for number in count())
        saved = _row_us(blocks, lambda block: [*map(np.save, names, block)])
    costs = {
        "a call with one step": (_call_us(columns), STEP_MS * 10),
        "a row, in blocks of 1 000": (recorded, 2 * saved),
    }
    return [
        {"part": part, "us": us, "target_us": target, "met": us <= target}
        for part, (us, target) in costs.items()
    ]


def _call_us(columns: Block) -> float:
    """Median microseconds of a call with one step."""
    took = []
    with tempfile.TemporaryDirectory() as folder, record("a", env="Hopper-v5", store=folder) as run:
        for row in range(LOOP_CALLS):
            step = [column[row] for column in columns]
            begun = perf_counter()
            run.transitions(*step)
            took.append(perf_counter() - begun)
    return 1e6 * median(took)


def _row_us(blocks: Sequence[Block], take: Callable[[Block], object]) -> float:
    """Mean CPU microseconds for a row of the blocks."""
    begun = process_time()
    for block in blocks:
        take(block)
    return 1e6 * (process_time() - begun) / len(blocks) / LOOP_BLOCK
