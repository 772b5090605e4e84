"""`tom bench studio`: how long the pages take over a store of many runs.

Pages are drawn in this process, without a browser: what is measured is reading, computing and
writing down the figures. CPU seconds beside wall-clock ones, as the machine may be busy.
"""

import argparse
import json
import logging
import os
import shutil
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import pandas as pd

from app.links import Links
from app.server import warm
from tom.cli.tables import show
from tom.presets import resolve
from tom.record import layout
from tom.record.reader import RunReader
from tom.record.store import Store
from tom.run import train

RUNS, METRICS, POINTS = 200, 20, 300
OPEN_S, ANSWER_S = 2.0, 0.5
"""the targets: opening the studio, and every page after that"""
ENV, LEARNERS, STEPS = "inverted-pendulum", ("mle", "pmac", "tom", "vagram"), 400
PAGES = ("live", "compare", "weights", "regions", "probe", "replays")
TIMEOUT_S = 600


@dataclass(frozen=True)
class Answer:
    """What one drawing of a page took, CPU and wall-clock seconds; `target_s` is for the CPU."""

    page: str
    cpu_s: float
    wall_s: float
    target_s: float

    @property
    def met(self) -> bool:
        return self.cpu_s <= self.target_s


def make_store(folder: Path, runs: int) -> None:
    """Train a short run of each learner, lengthen its curves, copy it until there are `runs`."""
    for learner in LEARNERS:
        config = resolve(ENV, learner, "smoke", {"steps": STEPS})
        train(config, Store(folder), f"{learner}-0", rerun=False)
        _lengthen(folder / f"{learner}-0")
    for i in range(len(LEARNERS), runs):
        learner, seed = LEARNERS[i % len(LEARNERS)], i // len(LEARNERS)
        copy = shutil.copytree(folder / f"{learner}-0", folder / f"{learner}-{seed}")
        config = json.loads((copy / layout.CONFIG).read_text())
        config |= {"seed": seed, "run_id": copy.name}
        config["config"]["seed"] = seed
        (copy / layout.CONFIG).write_text(json.dumps(config))


def _lengthen(run: Path) -> None:
    """Spread the run's metrics and profiles over as many rows as a long training has."""
    step = np.linspace(STEPS / POINTS, STEPS, POINTS).astype(int)
    old = RunReader(run).metrics().ffill().bfill()
    names = [name for name in old if name != "env_step"][:METRICS]
    table = pd.DataFrame({name: np.interp(step, old["env_step"], old[name]) for name in names})
    table.insert(0, "env_step", step)
    with (run / layout.METRICS).open("w") as file:
        table.to_json(file, orient="records", lines=True)
    table.to_parquet(run / layout.METRICS_TABLE)
    rows = [json.loads(line) for line in (run / layout.PROFILES).read_text().splitlines()]
    every = [{**rows[i * len(rows) // POINTS], "env_step": int(at)} for i, at in enumerate(step)]
    (run / layout.PROFILES).write_text("".join(json.dumps(row) + "\n" for row in every))


def measure(store: Path) -> Iterator[Answer]:
    """Open the first page, then every page for the first and for the second time."""
    from streamlit.testing.v1 import AppTest

    logging.disable(logging.WARNING)  # Streamlit misses its server
    os.environ |= Links(store=str(store)).environment()
    warm(str(store))  # as a server does when it starts
    opened: dict[str, AppTest] = {}
    for turn, words in enumerate(("first", "again")):
        for view in PAGES:
            script = f"from app.views import {view}\n{view}.page()\n"
            page = opened.setdefault(view, AppTest.from_string(script, default_timeout=TIMEOUT_S))
            wall, cpu = time.perf_counter(), time.process_time()
            page.run()
            cpu, wall = time.process_time() - cpu, time.perf_counter() - wall
            if page.exception:
                raise RuntimeError(page.exception[0].message)
            first = view == PAGES[0] and not turn
            yield Answer(f"{view}, {words}", cpu, wall, OPEN_S if first else ANSWER_S)


def main(argv: Sequence[str] | None = None) -> int:
    """Make a store and measure: 0 when every page meets its target, else 1."""
    parser = argparse.ArgumentParser(prog="tom bench studio")
    parser.add_argument("--runs", type=int, default=RUNS, help=f"runs in the store [{RUNS}]")
    parser.add_argument("--json", action="store_true", help="print JSON")
    args = parser.parse_args(argv)
    with tempfile.TemporaryDirectory() as folder:
        make_store(Path(folder), args.runs)
        answers = list(measure(Path(folder)))
    rows = [{**asdict(answer), "met": answer.met} for answer in answers]
    if args.json:
        print(json.dumps(rows))
    else:
        cells = [[f"{v:.2f}" if isinstance(v, float) else str(v) for v in r.values()] for r in rows]
        show(f"{args.runs} runs, {METRICS} metrics x {POINTS} points", list(rows[0]), cells)
    return 0 if all(answer.met for answer in answers) else 1


if __name__ == "__main__":
    raise SystemExit(main())
