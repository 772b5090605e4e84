"""The time to list a store of a thousand runs, a week of sweeps."""

import os
import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from time import perf_counter, process_time

from tom.bench.recording import recorded
from tom.record import layout
from tom.record.store import Store

RUNS, TARGET_S = 1000, 2.0


@dataclass(frozen=True)
class ListingCost:
    """CPU and wall-clock seconds of listing `runs` runs; the target is for the CPU."""

    runs: int
    cpu_s: float
    wall_s: float
    target_s: float = TARGET_S

    @property
    def met(self) -> bool:
        return self.cpu_s <= self.target_s


def measure(list_runs: Callable[[Path], object]) -> ListingCost:
    """Time the second call of `list_runs` on a store of RUNS runs; the first one loads code."""
    with tempfile.TemporaryDirectory() as folder:
        store = make_store(Path(folder))
        list_runs(store)
        wall, cpu = perf_counter(), process_time()
        list_runs(store)
        return ListingCost(RUNS, process_time() - cpu, perf_counter() - wall)


def make_store(folder: Path, runs: int = RUNS) -> Path:
    """Make a store of `runs` run folders in `folder`: copies of one recorded run."""
    one, many = Store(folder / "one"), folder / "many"
    recorded(one)
    (run,) = one.runs()
    for number in range(runs):
        copy = many / f"run-{number:04d}"
        copy.mkdir(parents=True)
        for name in (layout.CONFIG, layout.STATUS, layout.METRICS):
            os.link(run.path / name, copy / name)
    return many
