"""The cost of recording a training, of its checkpoints, and of listing many runs.

The load is that of Hopper late in the paper's schedule: 100 000 weights at every fit, ten
evaluation episodes of 1 000 steps every 1 000 steps, 250 new rows of the buffer, 30 metrics.
"""

import os
import tempfile
from collections.abc import Callable, Iterable, Sequence
from itertools import count
from pathlib import Path
from statistics import median
from time import perf_counter, process_time
from typing import Any

import numpy as np
import torch

from tom.config import OnlineConfig
from tom.data.transitions import TensorTransitions, Transitions
from tom.events import Collected, Episode, Evaluation, Event, Metrics, Tick, Weights
from tom.mbpo import Mbpo
from tom.metrics import METRICS
from tom.own_loop.run import record
from tom.record import checkpoint, layout
from tom.record.recorder import Recorder
from tom.record.rerun.sink import RerunSink
from tom.record.status import BEAT_S
from tom.record.store import Store
from tom.record.writer import RunWriter
from tom.training.presets import resolve

CYCLES = 20
CYCLE = 250  # env steps: one model fit
EVERY = 1000  # env steps between evaluations
WEIGHTS = 100_000
STEPS, EPISODES = 1000, 10
METRICS_A_ROW = 30
OBS, ACTION, NQ = 11, 3, 6
REPEATS = 3  # of a checkpoint
RUNS, LISTING_TARGET_S = 1000, 2.0  # a week of sweeps

Row = dict[str, Any]


def recording_costs(train_s: float) -> list[Row]:
    """CPU milliseconds for 250 env steps of each part and of all, without and with Rerun.

    Shares are relative to `train_s`, the CPU seconds of training for 250 env steps.
    """
    rng = np.random.default_rng(0)
    with tempfile.TemporaryDirectory() as folder:
        store = Store(Path(folder))
        ms = {name: _record(store, events) for name, events in _parts(rng).items()}
        ms["heartbeats"] = _heartbeats(store, train_s)
        files = sum(ms.values())
        rerun = _record(store, _all_parts(rng), rerun=True) - _record(store, _all_parts(rng))
    ms |= {"all files": files, "Rerun": rerun, "all files and Rerun": files + rerun}
    return [{"part": k, "ms": v, "share_percent": v / train_s / 10} for k, v in ms.items()]


def record_run(store: Store) -> None:
    """Record CYCLES times 250 env steps into a new run, without Rerun."""
    _record(store, _all_parts(np.random.default_rng(0)))


def checkpoint_costs(train_s: float) -> list[Row]:
    """A checkpoint of Hopper and of Humanoid with full buffers.

    `train_s` is the time of 250 training steps of Hopper. At most three checkpoints are on the disk
    at a time.
    """
    return [_checkpoint_cost("hopper", train_s), _checkpoint_cost("humanoid", None)]


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


# A loop of the user's own

LOOP_ROWS, LOOP_BLOCK, LOOP_CALLS = 1_000_000, 1000, 20_000
Block = tuple[np.ndarray, ...]  # the columns of a loop's rows
STEP_MS = 10.0  # of the loop, of which recording may take 1 %


def loop_costs() -> list[Row]:
    """`tom.record` with Hopper's rows in double precision: calls of one step, and of blocks.

    A call is the median of 20 000, and of 1 000 in a loop that leaves nothing in the caches; the
    target is 1 % of a step of 10 ms. Of 1 000 blocks of 1 000 rows it is twice what `numpy.save`
    takes for the same arrays: CPU time, without `close`, which makes digests.
    """
    rng = np.random.default_rng(0)
    walk = rng.normal(size=(LOOP_ROWS + 1, OBS)).cumsum(0)
    action, reward = rng.uniform(-1, 1, (LOOP_ROWS, ACTION)), rng.normal(size=LOOP_ROWS)
    cut = np.arange(LOOP_ROWS) % STEPS == STEPS - 1
    columns = walk[:-1], action, reward, walk[1:], np.zeros(LOOP_ROWS, bool), cut
    parts = [slice(first, first + LOOP_BLOCK) for first in range(0, LOOP_ROWS, LOOP_BLOCK)]
    blocks = [tuple(column[part] for column in columns) for part in parts]
    warm, cold = _call_us(columns, LOOP_CALLS, 0), _call_us(columns, LOOP_CALLS // 20, 4_000_000)
    with tempfile.TemporaryDirectory() as folder, record("a", env="Hopper-v5", store=folder) as run:
        recorded = _cpu_us(blocks, lambda block: run.transitions(*block))  # pyright: ignore
    with tempfile.TemporaryDirectory() as folder:
        names = (Path(folder) / str(number) for number in count())
        saved = _cpu_us(blocks, lambda block: [*map(np.save, names, block)])
    target_us = STEP_MS * 1e3 / 100
    costs = {
        "a call with one step": (warm, target_us),
        "a call with one step, caches cold": (cold, target_us),
        "a row, in blocks of 1 000": (recorded / LOOP_BLOCK, 2 * saved / LOOP_BLOCK),
    }
    return [
        {"part": part, "us": us, "target_us": target, "met": us <= target}
        for part, (us, target) in costs.items()
    ]


def _call_us(columns: Block, calls: int, between: int) -> float:
    """Median microseconds of a call with one step; `between` numbers are written before each."""
    others, took = np.zeros(between), []
    with tempfile.TemporaryDirectory() as folder, record("a", env="Hopper-v5", store=folder) as run:
        for row in range(calls):
            others += 1
            step = [column[row] for column in columns]
            begun = perf_counter()
            run.transitions(*step)
            took.append(perf_counter() - begun)
    return 1e6 * median(took)


def _cpu_us(blocks: Sequence[Block], take: Callable[[Block], object]) -> float:
    """Mean CPU microseconds that a block takes."""
    begun = process_time()
    for block in blocks:
        take(block)
    return 1e6 * (process_time() - begun) / len(blocks)


# Recording

Events = Callable[[int], Iterable[Event]]
"""the events of the 250 steps that end with an env step"""


def _parts(rng: np.random.Generator) -> dict[str, Events]:
    weight = rng.random(WEIGHTS, np.float32)
    values = {name: float(rng.random()) for name in list(METRICS)[:METRICS_A_ROW]}
    rows, version = _transitions(rng), np.zeros(CYCLE, np.int64)
    episodes = [_episode(rng) for _ in range(EPISODES)]
    return {
        "250 steps' ticks": lambda step: [Tick(s, "optimise") for s in range(step - CYCLE, step)],
        "a row of 30 metrics": lambda step: [Metrics(step, values), Tick(step, "optimise")],
        "profile and snapshot of 100k weights": lambda step: [Weights(step, weight)],
        "250 rows of the buffer": lambda step: [Collected(step, rows, version)],
        "10 episodes of 1000 steps / 4": lambda step: (
            [Evaluation(step, episodes)] if step % EVERY == 0 else []
        ),
    }


def _all_parts(rng: np.random.Generator) -> Events:
    parts = _parts(rng).values()
    return lambda step: [event for part in parts for event in part(step)]


def _record(store: Store, events: Events, *, rerun: bool = False) -> float:
    """Mean CPU milliseconds for 250 steps of `events`."""
    config = OnlineConfig(env="hopper", learner="tom", steps=CYCLE * CYCLES)
    writer = RunWriter.create(store, None, config)
    given = [event for n in range(1, CYCLES + 1) for event in events(CYCLE * n)]
    recorder = Recorder(writer, RerunSink(writer.path) if rerun else None)
    begun = process_time()
    for event in given:
        recorder.consume(event)
    recorder.finish("finished")
    return (process_time() - begun) * 1e3 / CYCLES


def _heartbeats(store: Store, seconds: float) -> float:
    """CPU milliseconds of the status updates in `seconds` of training."""
    config = OnlineConfig(env="hopper", learner="tom")
    writer = RunWriter.create(store, None, config)
    recorder = Recorder(writer)
    begun = process_time()
    for _ in range(CYCLES):
        recorder.beat()
    spent = process_time() - begun
    recorder.finish("finished")
    return spent * 1e3 / CYCLES * seconds / BEAT_S


def _transitions(rng: np.random.Generator) -> Transitions:
    obs, next_obs = rng.random((2, CYCLE, OBS), np.float32)
    reward, zeros = rng.random(CYCLE, np.float32), np.zeros(CYCLE, bool)
    return Transitions(obs, rng.random((CYCLE, ACTION), np.float32), reward, next_obs, zeros, zeros)


def _episode(rng: np.random.Generator) -> Episode:
    qpos, qvel = rng.random((2, STEPS + 1, NQ), np.float32)
    return Episode(
        reward=rng.random(STEPS, np.float32),
        action=rng.random((STEPS, ACTION), np.float32),
        obs=rng.random((STEPS + 1, OBS), np.float32),
        qpos=qpos,
        qvel=qvel,
    )


# Checkpoints


def _checkpoint_cost(env: str, train_s: float | None) -> Row:
    config = resolve(env, "tom", "paper")
    assert isinstance(config, OnlineConfig)
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
    seconds = sorted(times)[REPEATS // 2]
    between_s = None if train_s is None else train_s * config.checkpoint_every / CYCLE
    return {
        "run": f"{env} tom {config.preset}",
        "megabytes": megabytes,
        "megabytes_at_most": megabytes * (checkpoint.KEPT + 1),
        "ms": 1e3 * seconds,
        "share_percent": None if between_s is None else 100 * seconds / between_s,
    }
