"""The last `tom bench` of this kind of machine: `tom sweep --dry-run` projects hours from it."""

import json
from collections.abc import Mapping
from contextlib import suppress
from math import isfinite

from tom.bench.projection import NEEDED, per_step_ms, written_bytes
from tom.config import OnlineConfig
from tom.envs import task
from tom.machine.matmul import cache_file
from tom.record.files import replace
from tom.sweep.projection import Cost, steps_to_train
from tom.training.plan import Trial

SOURCE = "tom bench, at most"


def save(ms: Mapping[str, float]) -> None:
    """Store CPU milliseconds by part in the user's cache, if it can be written."""
    path = cache_file("bench")
    with suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True)
        replace(path, lambda file: file.write(json.dumps(dict(ms)).encode()), sync=False)


def last_bench() -> dict[str, float] | None:
    """The last stored result; None if there is none, or it is damaged or incomplete."""
    try:
        content = json.loads(cache_file("bench").read_text())
        ms = {name: float(content[name]) for name in NEEDED}
    except (OSError, ValueError, TypeError, KeyError):
        return None
    return ms if all(isfinite(value) and value > 0 for value in ms.values()) else None


def bench_cost(trial: Trial, ms: Mapping[str, float], done: int = 0) -> Cost | None:
    """The remaining cost of a training on one core of this machine, from step `done` on.

    None for road-and-rocks and for a GPU, which `tom bench` does not measure.
    """
    config = trial.config
    if not isinstance(config, OnlineConfig) or config.device != "cpu":
        return None
    known = task(trial.env)
    hours = per_step_ms(config, known, ms) * steps_to_train(trial, done) / 3.6e6
    rest = max(config.total_steps - done, 0) / config.total_steps
    return Cost(hours, written_bytes(config, known) * rest / 1e6, SOURCE)
