"""What `tom bench studio` measures: a real studio and its browsers, beside the targets.

Memory and processor seconds are those of all the studio's processes, which only Linux tells;
memory that they share counts once.
"""

import os
import re
import subprocess
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING

from app.router import VIEWS
from app.scenes.film import SECONDS, cinema, story
from app.servers.browser import CHARTS_DRAWN, chromium
from app.servers.cinema import film_tab, video
from tom.machine import processes
from tom.record.store import Store

if TYPE_CHECKING:
    from playwright.sync_api import Page, ViewportSize

FIRST_S, PAGE_S, FOUR_CPU_S = 6.0, 2.0, 0.3
FRESH_MB, USED_MB, CHANGES = 800.0, 1000.0, 200
IDLE_S, IDLE_PERCENT = 20.0, 2.0
FRAMES_A_SECOND = 30.0
FILM_S = 60.0
"""seconds that a film of SECONDS may take"""
READERS = 4
STOP_S = 5.0
DRAWN_S = {40_000: 0.5, 300_000: 1.0, 1_000_000: 3.0}
"""targets by number of rows: from a click to the drawn map"""
BRUSHED_S = {300_000: 0.05}
STEPPED_S = {40_000: 0.1}
MEMORY_MB = {1_000_000: 300.0}
SETTLE_MS, TIMEOUT_MS = 5000, 120_000
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


@dataclass(frozen=True)
class Measured:
    """One number of the studio, and the most (or least) that it should be."""

    what: str
    value: float
    unit: str
    target: float | None
    at_least: bool = False

    @property
    def met(self) -> bool:
        if self.target is None:
            return True
        return self.value >= self.target if self.at_least else self.value <= self.target


def measure(store: Path, played: str) -> Iterator[Measured]:
    """Start a studio of `store`, turn its pages, leave them alone, play the fits of a run, film it.

    Raises UserError if there is no browser, RuntimeError if the studio does not start.
    """
    with chromium() as browser, _studio(store) as (began, pid, address):
        contexts = [browser.new_context(base_url=address) for _ in range(READERS)]
        for context in contexts:
            context.set_default_timeout(TIMEOUT_MS)
        page = contexts[0].new_page()
        page.goto(address)
        _wait(page, VIEWS[0].TITLE)
        yield Measured("start to first useful page", time.monotonic() - began, "s", FIRST_S)
        page.wait_for_timeout(SETTLE_MS)
        yield Measured("memory, fresh", memory_mb(pid), "MB", FRESH_MB)
        for view in VIEWS:
            taken = median(_open_page(page, view.TITLE) for _ in range(3))
            yield Measured(f"{view.TITLE}, one browser", taken, "s", PAGE_S)
            page.wait_for_timeout(SETTLE_MS)
            before = processor_s(pid)
            page.wait_for_timeout(1000 * IDLE_S)
            busy = 100 * (processor_s(pid) - before) / IDLE_S
            yield Measured(f"{view.TITLE}, idle", busy, "% of a core", IDLE_PERCENT)
        page.goto(f"/attention?run={played}")
        page.wait_for_selector(".timeline button:not([disabled])")
        page.wait_for_timeout(SETTLE_MS)
        drawn = float(page.evaluate(COUNT_FRAMES))
        yield Measured("fits that play", drawn, "frames/s", FRAMES_A_SECOND, at_least=True)
        tabs = [page, *(context.new_page() for context in contexts[1:])]
        for view in VIEWS:
            before = processor_s(pid)
            for tab in tabs:
                tab.goto(f"/{view.PATH}", wait_until="commit")
            for tab in tabs:
                _wait(tab, view.TITLE)
            page.wait_for_timeout(1000)
            each = (processor_s(pid) - before) / READERS
            yield Measured(f"{view.TITLE}, {READERS} browsers", each, "CPU s a page", FOUR_CPU_S)
        for tab in tabs[1:]:
            tab.close()
        for i in range(CHANGES):
            _open_page(page, VIEWS[i % len(VIEWS)].TITLE)
        yield Measured(f"memory, {CHANGES} pages on", memory_mb(pid), "MB", USED_MB)
    run = Store(store).run(played)
    with film_tab(cinema(story(run), run.learner, "light")) as tab:
        began = time.monotonic()
        video(tab, SECONDS)
        yield Measured("film of a minute", time.monotonic() - began, "s", FILM_S)


def measure_map(store: Path, runs: Mapping[int, str]) -> Iterator[Measured]:
    """Open the map of runs, by their number of rows, in a browser; brush it; move the timeline.

    Raises UserError if there is no browser, RuntimeError if the studio does not start.
    """
    with chromium() as browser, _studio(store) as (_, _, address):
        viewport: ViewportSize = {"width": 1280, "height": 900}
        context = browser.new_context(viewport=viewport, base_url=address)
        context.set_default_timeout(TIMEOUT_MS)
        for rows, run in runs.items():
            for turn in ("first", "again"):
                page = context.new_page()
                page.goto(f"/findings?run={run}")
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
            memory = _script_mb(page)
            yield Measured(f"{rows:,} rows: page memory", memory, "MB", MEMORY_MB.get(rows))


def _open_page(page: "Page", title: str) -> float:
    """Click on a page's name; seconds until it is drawn."""
    other = VIEWS[0] if title != VIEWS[0].TITLE else VIEWS[1]
    if page.title().startswith(title):
        _open_page(page, other.TITLE)
    began = time.monotonic()
    page.get_by_role("link", name=title).first.click()
    _wait(page, title)
    return time.monotonic() - began


def _wait(page: "Page", title: str) -> None:
    """Wait until the page of this title is drawn: a drawing that ends sets the window's title."""
    page.wait_for_function("title => document.title.startsWith(title)", arg=title)
    page.wait_for_selector(".runlist .section")
    page.wait_for_selector('[data-testid="stSkeleton"]', state="detached")
    page.wait_for_selector('[data-testid="stStatusWidget"]', state="detached")
    page.wait_for_function(CHARTS_DRAWN)


@contextmanager
def _studio(store: Path) -> Iterator[tuple[float, int, str]]:
    """A studio as a user starts it: when, its process, and the address that it prints."""
    command = [sys.executable, "-m", "app", "--store", str(store), "--no-browser"]
    began = time.monotonic()
    studio = processes.start(command, subprocess.PIPE)
    try:
        assert studio.stdout is not None
        found = re.search(r"http://\S+", studio.stdout.readline().decode())
        if found is None:
            raise RuntimeError("the studio did not start")
        yield began, studio.pid, found[0]
    finally:
        processes.stop([studio], STOP_S)


def _process_tree(pid: int) -> list[Path]:
    """What the kernel says of a process and of all below it."""
    found = [Path("/proc", str(pid))]
    for one in found:
        for thread in (one / "task").iterdir():
            found += [Path("/proc", child) for child in (thread / "children").read_text().split()]
    return found


def memory_mb(pid: int) -> float:
    """MB of a process and of all below it."""
    kept = [(one / "smaps_rollup").read_text().partition("Pss:")[2] for one in _process_tree(pid)]
    return sum(int(text.split()[0]) for text in kept) * 1024 / 1e6


def processor_s(pid: int) -> float:
    """Processor seconds that a process and all below it have used."""
    rows = [(one / "stat").read_text().rpartition(")")[2].split() for one in _process_tree(pid)]
    return sum(int(ticks) for row in rows for ticks in row[11:13]) / os.sysconf("SC_CLK_TCK")


def _script_mb(page: "Page") -> float:
    """MB that the page's script holds: its heap and its arrays."""
    session = page.context.new_cdp_session(page)
    session.send("HeapProfiler.collectGarbage")
    used = session.send("Runtime.getHeapUsage")
    return (used["usedSize"] + used.get("backingStorageSize", 0)) / 1e6
