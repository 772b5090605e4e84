"""CPU time of recording during 250 environment steps of a training.

The load is that of Hopper late in the paper's schedule: 100 000 weights at every fit, ten
evaluation episodes of 1 000 steps every 1 000 steps, 250 new rows of the buffer, 30 metrics.
"""

import tempfile
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from time import process_time

import numpy as np

from tom.config import OnlineConfig
from tom.data.transitions import Transitions
from tom.events import Collected, Episode, Evaluation, Event, Metrics, Tick, Weights
from tom.metrics import METRICS
from tom.record.recorder import Recorder
from tom.record.rerun.sink import RerunSink
from tom.record.status import BEAT_S
from tom.record.store import Store
from tom.record.writer import RunWriter

CYCLES = 20
CYCLE = 250  # env steps: one model fit
EVERY = 1000  # env steps between evaluations
WEIGHTS = 100_000
STEPS, EPISODES = 1000, 10
METRICS_A_ROW = 30
OBS, ACTION, NQ = 11, 3, 6


@dataclass(frozen=True)
class RecordingCost:
    """CPU milliseconds that a part of recording takes per 250 env steps, and its share."""

    part: str
    ms: float
    share_percent: float | None


def cost(train_s: float | None = None) -> list[RecordingCost]:
    """The cost of each part and of all parts, without and with Rerun.

    Shares are relative to `train_s`, the CPU seconds of training for 250 env steps.
    """
    rng = np.random.default_rng(0)
    with tempfile.TemporaryDirectory() as folder:
        store = Store(Path(folder))
        ms = {name: _each(store, events) for name, events in _parts(rng).items()}
        ms["heartbeats"] = _heartbeats(store, train_s or CYCLE / 10)
        files = sum(ms.values())
        both = _all(store, rng, with_rerun=True) - _all(store, rng, with_rerun=False)
    ms |= {"all files": files, "Rerun": both, "all files and Rerun": files + both}
    return [RecordingCost(name, value, _share(value, train_s)) for name, value in ms.items()]


def recorded(store: Store) -> None:
    """Record CYCLES times 250 env steps into a new run, without Rerun."""
    _all(store, np.random.default_rng(0), with_rerun=False)


def _share(ms: float, train_s: float | None) -> float | None:
    return None if train_s is None else ms / train_s / 10


def _parts(rng: np.random.Generator) -> dict[str, Callable[[int], Iterable[Event]]]:
    """The events of the 250 steps that end with env step `step`."""
    weight = rng.random(WEIGHTS, np.float32)
    values = {name: float(rng.random()) for name in list(METRICS)[:METRICS_A_ROW]}
    rows, version = _transitions(rng), np.zeros(CYCLE, np.int64)
    episodes = [_episode(rng) for _ in range(EPISODES)]

    def evaluation(step: int) -> Sequence[Event]:
        return [Evaluation(step, episodes)] if step % EVERY == 0 else []

    return {
        "250 steps' ticks": lambda step: [Tick(s, "optimise") for s in range(step - CYCLE, step)],
        "a row of 30 metrics": lambda step: [Metrics(step, values), Tick(step, "optimise")],
        "profile and snapshot of 100k weights": lambda step: [Weights(step, weight)],
        "250 rows of the buffer": lambda step: [Collected(step, rows, version)],
        "10 episodes of 1000 steps / 4": evaluation,
    }


def _all(store: Store, rng: np.random.Generator, *, with_rerun: bool) -> float:
    parts = _parts(rng).values()
    return _each(store, lambda s: [e for part in parts for e in part(s)], with_rerun=with_rerun)


def _each(
    store: Store, events: Callable[[int], Iterable[Event]], *, with_rerun: bool = False
) -> float:
    """Mean CPU milliseconds for 250 steps of `events`."""
    config = OnlineConfig(env="hopper", learner="tom", steps=CYCLE * CYCLES)
    writer = RunWriter.create(store, store.new_run_id("bench", "tom", 0), config)
    given = [list(events(CYCLE * cycle)) for cycle in range(1, CYCLES + 1)]
    recorder = Recorder(writer, RerunSink(writer.path) if with_rerun else None)
    begun = process_time()
    for event in (event for cycle in given for event in cycle):
        recorder.consume(event)
    recorder.finish("finished")
    return (process_time() - begun) * 1e3 / CYCLES


def _heartbeats(store: Store, seconds: float) -> float:
    """CPU milliseconds of the status updates in `seconds` of training."""
    config = OnlineConfig(env="hopper", learner="tom")
    writer = RunWriter.create(store, store.new_run_id("bench", "tom", 0), config)
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
