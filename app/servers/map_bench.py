"""`tom bench studio --map`: how long the buffer's map takes in a browser, by the number of rows."""

from collections.abc import Iterator
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING

import numpy as np

from app.servers.browser import chromium
from app.servers.browser_bench import Measured
from app.servers.launcher import Studio, serving
from tom.data.transitions import Transitions
from tom.envs import task
from tom.events import Collected, Weights
from tom.record.status import Status
from tom.record.store import Store
from tom.record.writer import SEGMENT_ROWS, RunWriter
from tom.training.presets import resolve

if TYPE_CHECKING:
    from playwright.sync_api import Page

ENV = "hopper"
EPISODE = 500
"""steps of an episode"""
DRAWN_S = {40_000: 0.5, 300_000: 1.0, 1_000_000: 3.0}
"""targets by number of rows: from a click to the drawn map"""
BRUSHED_S = {300_000: 0.05}
STEPPED_S = {40_000: 0.1}
MEMORY_MB = {1_000_000: 300.0}
TIMEOUT_MS = 120_000
SETTLE_MS = 3000
CLICK = """async () => {
    const link = [...document.querySelectorAll("a[data-testid=stTopNavLink]")]
        .find(({ href }) => new URL(href).pathname.endsWith("/attention"));
    const begun = performance.now();
    link.click();
    for (;;) {
        await new Promise(requestAnimationFrame);
        const map = document.querySelector(".buffer-map");
        if (map?.drawnAt) return (map.drawnAt - begun) / 1000;
    }
}"""
"""opens Attention from another page; seconds until the map is drawn"""
BRUSH = """async () => {
    const map = document.querySelector(".buffer-map");
    const canvas = map.querySelector(".map-hist[data-name='reward'] canvas");
    const { left, width, top } = canvas.getBoundingClientRect();
    const at = (share, kind) => canvas.dispatchEvent(new PointerEvent(kind, {
        clientX: left + share * width, clientY: top + 5, pointerId: 1, bubbles: true }));
    canvas.setPointerCapture = () => {};
    at(0.3, "pointerdown");
    const taken = [];
    for (let i = 0; i < 12; i++) {
        const begun = performance.now();
        at(0.4 + 0.02 * i, "pointermove");
        taken.push(map.drawnAt - begun);
        await new Promise(requestAnimationFrame);
    }
    at(0.64, "pointerup");
    return taken.sort((a, b) => a - b)[taken.length >> 1] / 1000;
}"""
"""drags over a histogram; median seconds from a move to all panels drawn"""
STEP = """async () => {
    const map = document.querySelector(".buffer-map");
    const taken = [];
    for (const { step } of [...map.given.sources, ...map.given.sources]) {
        const begun = performance.now();
        window.dispatchEvent(new CustomEvent("tom:step", { detail: step }));
        if (map.drawnAt > begun) taken.push(map.drawnAt - begun);
        await new Promise(requestAnimationFrame);
    }
    return taken.sort((a, b) => a - b)[taken.length >> 1] / 1000;
}"""
"""moves the timeline from fit to fit; median seconds until the map shows the fit"""


def make_run(store: Path, rows: int, fits: int = 3) -> str:
    """A run of Hopper's dimensions with `rows` rows of noise, and weights that differ in it.

    Its rows are recorded in as many parts as those of a training.
    """
    known, draw = task(ENV), np.random.default_rng(0)
    config = resolve(ENV, "tom", "smoke", {})
    writer = RunWriter.create(Store(store), f"map-{rows}", config)
    obs = draw.normal(size=(rows + 1, known.obs_dim)).astype(np.float32)
    action = draw.uniform(-1, 1, (rows, known.action_dim)).astype(np.float32)
    ended = (np.arange(rows) % EPISODE == EPISODE - 1).astype(np.float32)
    recorded = Transitions(obs[:-1], action, obs[:-1, 0], obs[1:], ended * 0, ended)
    version = np.arange(rows) // (rows // 100)
    for first in range(0, rows, SEGMENT_ROWS):
        part = slice(first, first + SEGMENT_ROWS)
        writer.rows(Collected(0, recorded[part], version[part]))
    for i in range(fits):
        end = rows * (i + 1) // fits
        weight = np.exp(obs[:end, 0] + 0.5 * obs[:end, 1] * i)
        fitted = Weights(end, (weight / weight.mean()).astype(np.float32), policy=None)
        writer.snapshot(fitted, keep=True)
        writer.profile(fitted, 100)
    writer.status(Status(state="finished", env_step=rows))
    writer.close()
    return f"map-{rows}"


def measure(folder: Path, sizes: tuple[int, ...] = tuple(DRAWN_S)) -> Iterator[Measured]:
    """Open the map of a run of each size in a browser, brush it, and move the timeline.

    Raises UserError if there is no browser, RuntimeError if the studio does not start.
    """
    runs = {rows: make_run(folder, rows) for rows in sizes}
    with serving(Studio(store=folder), Event()) as (links, running), chromium() as browser:
        if running is None:
            raise RuntimeError("the studio did not start")
        context = browser.new_context(viewport={"width": 1280, "height": 900})
        for rows, run in runs.items():
            for turn in ("first", "again"):
                page = context.new_page()
                page.set_default_timeout(TIMEOUT_MS)
                page.goto(links.opened(f"findings?run={run}"))
                page.locator(".runlist .section").first.wait_for()
                page.wait_for_timeout(SETTLE_MS)
                drawn = float(page.evaluate(CLICK))
                what = f"{rows:,} rows, {turn}: click to map"
                yield Measured(what, drawn, "s", DRAWN_S.get(rows))
            page.wait_for_function("document.querySelector('.buffer-map').dataset.loaded")
            page.wait_for_timeout(SETTLE_MS)
            yield Measured(f"{rows:,} rows: brush", page.evaluate(BRUSH), "s", BRUSHED_S.get(rows))
            page.wait_for_timeout(SETTLE_MS)
            step = page.evaluate(STEP)
            yield Measured(f"{rows:,} rows: timeline step", step, "s", STEPPED_S.get(rows))
            yield Measured(f"{rows:,} rows: page memory", memory(page), "MB", MEMORY_MB.get(rows))


def memory(page: "Page") -> float:
    """MB that the page's script holds: its heap and its arrays."""
    session = page.context.new_cdp_session(page)
    session.send("HeapProfiler.collectGarbage")
    used = session.send("Runtime.getHeapUsage")
    return (used["usedSize"] + used.get("backingStorageSize", 0)) / 1e6
