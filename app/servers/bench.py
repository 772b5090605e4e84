"""`tom bench studio`: a store of many runs, and a real studio of it beside its targets."""

import argparse
import json
import shutil
import tempfile
from collections.abc import Iterable, Sequence
from contextlib import chdir
from dataclasses import asdict
from pathlib import Path

import numpy as np
import pandas as pd
from PIL import Image

from app.data.studies import FOLDER, REPORT
from app.servers import browser_bench
from app.servers.browser_bench import Measured
from tom.cli import Parser
from tom.cli.output import show_rows
from tom.data.transitions import Transitions
from tom.envs import ROAD, task
from tom.events import Collected, Weights
from tom.record import layout
from tom.record.reader import RunReader
from tom.record.status import Status
from tom.record.store import Store
from tom.record.writer import SEGMENT_ROWS, RunWriter
from tom.studies import STUDIES
from tom.training.presets import resolve
from tom.training.run import train

RUNS, METRICS, POINTS = 200, 20, 300
KINDS = (
    *((ROAD, learner, {"steps": 60, "fit_every": 30}) for learner in ("mle", "tom")),
    *(
        ("inverted-pendulum", learner, {"steps": 400})
        for learner in ("mle", "pmac", "tom", "vagram")
    ),
)
"""the trained runs, in turn: task, learner, settings"""
SHOWN, FIGURES, LINES = STUDIES[:3], 2, 300
"""the studies of their page, and the number of figures and table lines of each"""
MAP_ENV, MAP_FITS = "hopper", 3
EPISODE = 500
"""steps of an episode of the map's runs"""
PLAYED, FITS = "inverted-pendulum-tom-0", 120
"""the run that plays in a browser, and its fits"""


def make_store(folder: Path, runs: int) -> None:
    """Train a short run of each kind, extend its curves, and copy it until there are `runs`."""
    for env, learner, settings in KINDS:
        config = resolve(env, learner, "smoke", settings)
        train(config, Store(folder), f"{env}-{learner}-0", rerun=False)
        _extend_metrics(folder / f"{env}-{learner}-0")
    for i in range(len(KINDS), runs):
        (env, learner, _), seed = KINDS[i % len(KINDS)], i // len(KINDS)
        base = f"{env}-{learner}"
        copy = shutil.copytree(folder / f"{base}-0", folder / f"{base}-{seed}")
        config = json.loads((copy / layout.CONFIG).read_text())
        config |= {"seed": seed, "run_id": copy.name}
        config["config"]["seed"] = seed
        (copy / layout.CONFIG).write_text(json.dumps(config))


def make_studies(folder: Path) -> None:
    """Make studies like those of `tom reproduce`: figures of noise, a table, a report."""
    noise = np.random.default_rng(0)
    for name in SHOWN:
        study = folder / name
        study.mkdir(parents=True)
        for i in range(FIGURES):
            pixels = noise.integers(0, 255, (600, 1200, 3), np.uint8)
            Image.fromarray(pixels).save(study / f"figure-{i}.png")
        table = pd.DataFrame(noise.normal(size=(LINES, 8)), columns=list("abcdefgh"))
        table.to_csv(study / "cases.csv", index=False)
        (study / REPORT).write_text("<!doctype html><title>report</title>")


def make_run(store: Path, rows: int) -> str:
    """A run of Hopper's dimensions with `rows` rows of noise, and weights that differ in it.

    Its rows are recorded in as many parts as those of a training.
    """
    known, draw = task(MAP_ENV), np.random.default_rng(0)
    config = resolve(MAP_ENV, "tom", "smoke", {})
    writer = RunWriter.create(Store(store), f"map-{rows}", config)
    obs = draw.normal(size=(rows + 1, known.obs_dim)).astype(np.float32)
    action = draw.uniform(-1, 1, (rows, known.action_dim)).astype(np.float32)
    ended = (np.arange(rows) % EPISODE == EPISODE - 1).astype(np.float32)
    recorded = Transitions(obs[:-1], action, obs[:-1, 0], obs[1:], ended * 0, ended)
    version = np.arange(rows) // (rows // 100)
    for first in range(0, rows, SEGMENT_ROWS):
        part = slice(first, first + SEGMENT_ROWS)
        writer.rows(Collected(0, recorded[part], version[part]))
    for i in range(MAP_FITS):
        end = rows * (i + 1) // MAP_FITS
        weight = np.exp(obs[:end, 0] + 0.5 * obs[:end, 1] * i)
        fitted = Weights(end, (weight / weight.mean()).astype(np.float32), policy=None)
        writer.snapshot(fitted, keep=True)
        writer.profile(fitted, 100)
    writer.status(Status(state="finished", env_step=rows))
    writer.close()
    return f"map-{rows}"


def _extend_metrics(run: Path, points: int = POINTS) -> None:
    """Extend the run's metrics and profiles to the number of rows of a long training."""
    old = RunReader(run).metrics().ffill().bfill()
    last = int(old["env_step"].to_numpy().max())
    step = np.linspace(1, max(last, points), points).astype(int)
    names = [name for name in old if name != "env_step"][:METRICS]
    table = pd.DataFrame({name: np.interp(step, old["env_step"], old[name]) for name in names})
    table.insert(0, "env_step", step)
    with (run / layout.METRICS).open("w") as file:
        table.to_json(file, orient="records", lines=True)
    table.to_parquet(run / layout.METRICS_TABLE)
    rows = [json.loads(line) for line in (run / layout.PROFILES).read_text().splitlines()]
    every = [{**rows[i * len(rows) // points], "env_step": int(at)} for i, at in enumerate(step)]
    (run / layout.PROFILES).write_text("".join(json.dumps(row) + "\n" for row in every))


def main(argv: Sequence[str] | None = None) -> int:
    """Make a store and measure: 0 if every target is met, 1 if not, 2 for bad input."""
    parser = Parser(prog="tom bench studio")
    parser.add_argument("--runs", type=int, default=RUNS, help=f"runs in the store [{RUNS}]")
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.add_argument("--map", action="store_true", help="the buffer's map")
    args = parser.parse_args(argv)
    if args.runs < len(KINDS):
        parser.error(f"--runs {args.runs}: at least {len(KINDS)}, one of each kind")
    with tempfile.TemporaryDirectory() as folder, chdir(folder):
        store = Path(folder) / "runs"
        if args.map:
            runs = {rows: make_run(store, rows) for rows in browser_bench.DRAWN_S}
            found = browser_bench.measure_map(store, runs)
            return _report("the buffer's map in Chromium", found, args)
        make_store(store, args.runs)
        _extend_metrics(store / PLAYED, FITS)
        make_studies(Path(folder) / FOLDER)
        title = f"{args.runs} runs, {METRICS} metrics x {POINTS} points, in Chromium"
        return _report(title, browser_bench.measure(store, PLAYED), args)


def _report(title: str, found: Iterable[Measured], args: argparse.Namespace) -> int:
    """Print what was measured: 0 if every target is met, else 1."""
    rows = [{**asdict(one), "met": one.met} for one in found]
    if args.json:
        print(json.dumps(rows))
    else:
        show_rows(title, rows)
    return 0 if all(row["met"] for row in rows) else 1


if __name__ == "__main__":
    raise SystemExit(main())
