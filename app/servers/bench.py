"""`tom bench studio`: how long the pages take over a store of many runs.

The first row is the server's reading of the whole store when it starts. A user who opens the studio
at that moment waits for all of it and for the first page: the row `opened`. Every other row is one
drawing of one page after that, or `four readers`: the same page drawn for four browsers one after
another, which is the time that the last of them waits.

Pages are drawn in this process without a browser, so the times include reading, computing and
serialising the figures, but neither the start of Python and Streamlit nor the browser's work. CPU
seconds are given beside wall-clock seconds, because the machine may be busy.
"""

import json
import logging
import os
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import chdir
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from threading import Event

import numpy as np
import pandas as pd
from PIL import Image
from streamlit.testing.v1 import AppTest

from app.data.studies import FOLDER, QUESTIONS, REPORT
from app.links import Links
from app.router import VIEWS
from app.servers import map_bench
from app.servers.browser import DRAWN, chromium
from app.servers.launcher import Studio, serving
from app.servers.pages import warm
from tom.cli import Parser
from tom.cli.tables import show
from tom.envs import ROAD
from tom.record import layout
from tom.record.reader import RunReader
from tom.record.store import Store
from tom.training.presets import resolve
from tom.training.run import train

RUNS, METRICS, POINTS = 200, 20, 300
OPEN_S, ANSWER_S = 2.0, 0.5
"""the targets: opening the studio, and every page after that"""
READERS = 4
"""browsers that request a page at the same time; Python serves one after another"""
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
PAGES = tuple(view.name for view in VIEWS)
HARNESS = (
    "import streamlit as st\n"
    "if 'measured' in st.session_state:\n"
    "    from app.router import VIEWS, draw\n"
    "    draw(next(view.page for view in VIEWS if view.name == '{0}'))\n"
)
"""The first run of an AppTest searches all installed packages, unlike a running server."""
TIMEOUT_S = 600
FITS, FRAMES_A_SECOND = 120, 30
"""of a run that plays in a browser: its fits, and the target"""
SETTLE_MS = 5000
COUNT_FRAMES = """() => new Promise((done) => {
    const play = document.querySelector(".timeline button");
    let frames = 0;
    play.click();
    const begun = performance.now();
    const count = () => {
        frames += 1;
        const ended = frames > 5 && play.getAttribute("aria-label") === "Play";
        if (ended) done((1000 * frames) / (performance.now() - begun));
        else requestAnimationFrame(count);
    };
    requestAnimationFrame(count);
})"""
"""plays the timeline to its end, and counts the frames that the browser draws meanwhile"""


@dataclass(frozen=True)
class Answer:
    """CPU and wall-clock seconds of one measurement; the target is for the CPU."""

    what: str
    cpu_s: float
    wall_s: float
    target_s: float | None = ANSWER_S

    @property
    def met(self) -> bool:
        return self.target_s is None or self.cpu_s <= self.target_s


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


def frames(store: Path) -> float:
    """Frames a second of Attention in a browser while `FITS` fits of a run play.

    Raises UserError if there is no browser, RuntimeError if the studio does not start.
    """
    config = resolve("inverted-pendulum", "tom", "smoke", {"steps": 400})
    train(config, Store(store), "played", rerun=False)
    _lengthen(store / "played", FITS)
    with serving(Studio(store=store), Event()) as (links, running), chromium() as browser:
        if running is None:
            raise RuntimeError("the studio did not start")
        page = browser.new_page(viewport={"width": 1280, "height": 900})
        page.goto(links.opened("attention"))
        page.wait_for_selector(".timeline button:not([disabled])")
        page.wait_for_function(DRAWN)
        page.wait_for_timeout(SETTLE_MS)
        return float(page.evaluate(COUNT_FRAMES))


def measure(store: Path) -> Iterator[Answer]:
    """Read the store, draw every page for the first time, again, and for four readers."""
    os.environ |= Links(store=str(store)).environment()
    read = timed("store read", lambda: warm(str(store)))  # as at the start of a server
    yield replace(read, target_s=None)
    opened: dict[str, AppTest] = {}
    for turn in ("first", "again"):
        for view in PAGES:
            if view not in opened:
                opened[view] = _reader(view)
            answer = timed(f"{view}, {turn}", opened[view].run)
            if opened[view].exception:
                raise RuntimeError(opened[view].exception[0].message)
            yield answer
            if len(opened) == 1 and turn == "first":
                both = read.cpu_s + answer.cpu_s, read.wall_s + answer.wall_s
                yield Answer(f"opened: store read + {view}, first", *both, OPEN_S)
    for view in PAGES:
        readers = [_reader(view) for _ in range(READERS)]
        four = timed(f"{view}, four readers", lambda readers=readers: [r.run() for r in readers])
        yield replace(four, target_s=OPEN_S)


def _reader(view: str) -> AppTest:
    """A browser's session on a page that is not drawn yet."""
    reader = AppTest.from_string(HARNESS.format(view), default_timeout=TIMEOUT_S)
    reader.run()
    reader.session_state["measured"] = True
    return reader


def timed(what: str, do: Callable[[], object]) -> Answer:
    """Time one call of `do`; the CPU time is that of all threads of this process."""
    wall, cpu = time.perf_counter(), time.process_time()
    do()
    return Answer(what, time.process_time() - cpu, time.perf_counter() - wall)


def main(argv: Sequence[str] | None = None) -> int:
    """Make a store and measure: 0 if every page meets its target, 1 if not, 2 for bad input."""
    parser = Parser(prog="tom bench studio")
    parser.add_argument("--runs", type=int, default=RUNS, help=f"runs in the store [{RUNS}]")
    parser.add_argument("--json", action="store_true", help="print JSON")
    parser.add_argument("--frames", action="store_true", help="frames a second while fits play")
    parser.add_argument("--map", action="store_true", help="the buffer's map in a browser")
    args = parser.parse_args(argv)
    if args.map:
        return _map(json_wanted=args.json)
    if args.frames:
        with tempfile.TemporaryDirectory() as folder:
            drawn = frames(Path(folder))
        print(
            json.dumps({"frames_per_s": drawn, "target": FRAMES_A_SECOND})
            if args.json
            else f"{drawn:.1f} frames a second while {FITS} fits play (target {FRAMES_A_SECOND})"
        )
        return 0 if drawn >= FRAMES_A_SECOND else 1
    if args.runs < len(KINDS):
        parser.error(f"--runs {args.runs}: at least {len(KINDS)}, one of each kind")
    logging.disable(logging.WARNING)  # Streamlit warns that there is no server
    with tempfile.TemporaryDirectory() as folder, chdir(folder):
        make_store(Path(folder) / "runs", args.runs)
        make_studies(Path(folder) / FOLDER)
        answers = list(measure(Path(folder) / "runs"))
    rows = [{**asdict(answer), "met": answer.met} for answer in answers]
    if args.json:
        print(json.dumps(rows))
    else:
        cells = [[_cell(value) for value in row.values()] for row in rows]
        show(f"{args.runs} runs, {METRICS} metrics x {POINTS} points", list(rows[0]), cells)
    return 0 if all(answer.met for answer in answers) else 1


def _map(*, json_wanted: bool) -> int:
    """Print what `map_bench` measures: 0 if every target is met, else 1."""
    with tempfile.TemporaryDirectory() as folder:
        found = list(map_bench.measure(Path(folder)))
    rows = [{**asdict(one), "met": one.met} for one in found]
    if json_wanted:
        print(json.dumps(rows))
    else:
        cells = [[_cell(value) for value in row.values()] for row in rows]
        show("the buffer's map in Chromium", list(rows[0]), cells)
    return 0 if all(one.met for one in found) else 1


def _cell(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.2f}"
    return "-" if value is None else str(value)


if __name__ == "__main__":
    raise SystemExit(main())
