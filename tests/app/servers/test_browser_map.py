"""The buffer's map in a real browser: it chooses the rows that the server chooses."""

from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import quote

import numpy as np
import pytest
from studio_browser import NEEDS_BROWSER, Visit, asked, until
from studio_runs import PENDULUM_TOM

from app.data import buffer_map, columns
from app.data.selection import Selection
from app.servers import bench, browser_bench
from tom.record.reader import RunReader

if TYPE_CHECKING:
    from playwright.sync_api import Page

pytestmark = NEEDS_BROWSER
CHOSEN = """() => {
  const { rows } = document.querySelector(".buffer-map");
  return [...rows.failed].flatMap((failed, i) => (failed ? [] : [rows.first + i]));
}"""
CASES = (
    {"where": ["pole angle -0.01..0.02", "age 20..", "reward ..1"]},
    {"where": ["weight 0.5..2"]},
    {"where": ["weight ..0"]},
    {"where": ["weight rank 90.."], "outline": ["contrast@300 -1,-2;3.5,-2;0.25,2.5"]},
    {"outline": ["two@cart x|pole angle -9,-9;0,-9;0.001,0.0213;-9,9"], "plane": ["principal"]},
)


def opened(visit: Visit, **query: list[str]) -> "Page":
    words = "&".join(f"{key}={quote(one)}" for key, of in query.items() for one in of)
    visit.page.goto(visit.links.opened(f"attention?run={PENDULUM_TOM}&step=300&{words}"))
    visit.page.locator(".buffer-map[data-loaded]").wait_for()
    filters = len(query.get("where", [])) + len(query.get("outline", []))
    applied = f"document.querySelector('.buffer-map').rows.applied?.size === {filters}"
    until(visit.page, lambda: visit.page.evaluate(applied), "not all filters were applied")
    return visit.page


def on_the_server(store: Path, where: list[str], outline: list[str]) -> list[int]:
    run = RunReader(store / PENDULUM_TOM)
    source = buffer_map.sources(run)["300"]
    mask = buffer_map.chosen(run, source, Selection.of(where, outline))
    return (source.first + np.flatnonzero(mask)).tolist()


@pytest.mark.quick
def test_browser_and_server_choose_the_same_rows(visit: Visit, own: Path) -> None:
    sizes = set()
    for case in CASES:
        page = opened(visit, **case)
        expected = on_the_server(own, case.get("where", []), case.get("outline", []))
        assert page.evaluate(CHOSEN) == expected
        sizes.add(len(expected))
    assert len(sizes) > 2


def test_a_brush_a_lasso_and_back(visit: Visit, own: Path) -> None:
    page = opened(visit)
    canvas = page.locator(".map-hist[data-name='pole angle'] canvas")
    canvas.scroll_into_view_if_needed()
    box = canvas.bounding_box()
    assert box is not None
    y = box["y"] + box["height"] / 2
    page.mouse.move(box["x"] + 0.3 * box["width"], y)
    page.mouse.down()
    page.mouse.move(box["x"] + 0.6 * box["width"], y, steps=5)
    page.mouse.up()
    page.wait_for_url("**/attention?*where=*")

    def agree() -> bool:
        words = asked(page)
        expected = on_the_server(own, words.get("where", []), words.get("outline", []))
        return page.evaluate(CHOSEN) == expected

    until(page, agree, "browser and server choose other rows")
    brushed = page.evaluate(CHOSEN)
    map_box = page.locator(".map-over").bounding_box()
    assert map_box is not None
    for i, (a, b) in enumerate([(0.3, 0.2), (0.8, 0.3), (0.6, 0.9), (0.2, 0.6)]):
        page.mouse.move(
            map_box["x"] + a * map_box["width"], map_box["y"] + b * map_box["height"], steps=4
        )
        if not i:
            page.mouse.down()
    page.mouse.up()
    page.wait_for_url("**/attention?*outline=*")
    until(page, agree, "browser and server choose other rows")
    both = page.evaluate(CHOSEN)
    assert 0 < len(both) < len(brushed) < 300
    page.reload()
    page.locator(".buffer-map[data-loaded]").wait_for()
    until(page, lambda: page.evaluate(CHOSEN) == both, "a reload loses the selection")
    page.go_back()
    until(page, lambda: page.evaluate(CHOSEN) == brushed, "Back keeps the outline")


def test_the_map_shows_a_fits_own_weights_as_soon_as_the_timeline_moves(
    visit: Visit,
    own: Path,
) -> None:
    first, last = (buffer_map.fits(RunReader(own / PENDULUM_TOM))[fit] for fit in ("200", "300"))
    page = opened(visit)
    shown = "() => [...document.querySelector('.buffer-map').rows.own.weight]"
    assert page.evaluate(shown) == columns.weight_codes(last.weight).tolist()
    page.evaluate(
        """() => window.addEventListener("tom:step", () => {
            window.atOnce = [...document.querySelector(".buffer-map").rows.own.weight];
        })"""
    )
    page.get_by_role("slider", name="Step of the training").focus()
    page.keyboard.press("Home")
    until(page, lambda: page.evaluate("window.atOnce"), "the timeline stands")
    assert page.evaluate("window.atOnce") == columns.weight_codes(first.weight).tolist()
    page.wait_for_url("**/attention?*step=200*")
    page.get_by_role("button", name="Save all 200 rows (Parquet)").wait_for()


def test_the_bench_measures_a_buffer(tmp_path: Path) -> None:
    found = list(browser_bench.measure_map(tmp_path, {400: bench.make_run(tmp_path, 400)}))
    assert [one.what for one in found] == [
        f"400 rows{what}"
        for what in (
            ", first: click to map", ", again: click to map", ": brush", ": timeline step",
            ": page memory",
        )
    ]  # fmt: skip
    assert all(one.value > 0 and one.target is None for one in found)
