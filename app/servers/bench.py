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

from app.data.studies import FOLDER, QUESTIONS, REPORT
from app.servers import browser_bench, map_bench
from app.servers.browser_bench import Measured
from tom.cli import Parser
from tom.cli.output import show_rows
from tom.envs import ROAD
from tom.record import layout
from tom.record.reader import RunReader
from tom.record.store import Store
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
STUDIES, FIGURES, LINES = 3, 2, 300
"""for the page of studies: number of figures and table lines of each"""
PLAYED, FITS = "inverted-pendulum-tom-0", 120
"""the run that plays in a browser, and its fits"""


def make_store(folder: Path, runs: int) -> None:
    """Train a short run of each kind, extend its curves, and copy it until there are `runs`."""
    for env, learner, settings in KINDS:
        config = resolve(env, learner, "smoke", settings)
        train(config, Store(folder), f"{env}-{learner}-0", rerun=False)
        _lengthen(folder / f"{env}-{learner}-0")
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
    for name in list(QUESTIONS)[:STUDIES]:
        study = folder / name
        study.mkdir(parents=True)
        for i in range(FIGURES):
            pixels = noise.integers(0, 255, (600, 1200, 3), np.uint8)
            Image.fromarray(pixels).save(study / f"figure-{i}.png")
        table = pd.DataFrame(noise.normal(size=(LINES, 8)), columns=list("abcdefgh"))
        table.to_csv(study / "cases.csv", index=False)
        (study / REPORT).write_text("<!doctype html><title>report</title>")


def _lengthen(run: Path, points: int = POINTS) -> None:
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
            return _shown("the buffer's map in Chromium", map_bench.measure(Path(folder)), args)
        make_store(store, args.runs)
        _lengthen(store / PLAYED, FITS)
        make_studies(Path(folder) / FOLDER)
        title = f"{args.runs} runs, {METRICS} metrics x {POINTS} points, in Chromium"
        return _shown(title, browser_bench.measure(store, PLAYED), args)


def _shown(title: str, found: Iterable[Measured], args: argparse.Namespace) -> int:
    """Print what was measured: 0 if every target is met, else 1."""
    rows = [{**asdict(one), "met": one.met} for one in found]
    if args.json:
        print(json.dumps(rows))
    else:
        show_rows(title, rows)
    return 0 if all(row["met"] for row in rows) else 1


if __name__ == "__main__":
    raise SystemExit(main())
