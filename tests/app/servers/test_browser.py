"""The studio in a real browser: its frames really draw, nothing fails, nothing goes outside."""

from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import quote

import numpy as np
import pytest
from common import present
from studio_browser import (
    CALM,
    LOCAL,
    NEEDS_BROWSER,
    Visit,
    asked,
    drawn,
    settle,
    until,
    wait_until_drawn,
    wait_until_steady,
)
from studio_runs import PENDULUM_TOM, ROAD_TOM

from app.data import buffer_map, columns
from app.data.selection import Selection
from tom.record.reader import RunReader, at_or_before

if TYPE_CHECKING:
    from playwright.sync_api import Page

pytestmark = NEEDS_BROWSER
START = "curves?task=inverted-pendulum"


@pytest.mark.quick
def test_a_visit_to_every_page(visit: Visit, store: Path) -> None:
    page = visit.page
    page.goto(visit.links.user_address(f"replays?run={PENDULUM_TOM}&part=Rerun"))
    page.wait_for_url(lambda address: "key" not in address)
    wait_until_drawn(page.locator("iframe").last, 0.03)  # Rerun: the robot, the bars, the curves

    visit.open("Answer", "")
    page.get_by_text("Does it help?").wait_for()
    visit.open("Curves", "curves")
    page.locator(".js-plotly-plot").nth(1).wait_for()
    click_the_end_of_a_curve(page)
    visit.open("Attention", "attention")
    click_the_first_fit(page, store)
    page.get_by_role("radio", name="Every learner on one buffer").click()
    page.get_by_role("button", name="Weigh", exact=True).wait_for()
    visit.open("Replays", "replays")
    play_an_episode(page)
    see_it_in_rerun(page)
    see_runs_side_by_side(page)
    visit.open("Findings", "findings")
    page.get_by_text("tom reproduce").first.wait_for()
    page.goto(f"{visit.links.address}/road?run={ROAD_TOM}")  # as older studios had it
    wait_until_drawn(page.locator("iframe").first, 0.03)  # viser: columns of weight
    assert visit.asked <= LOCAL


def click_the_end_of_a_curve(page: "Page") -> None:
    chart = drawn(page)
    place = """plot => {
        const trace = plot.calcdata.findLast(points => points[0].trace.mode?.includes('lines')
            && points[0].trace.name?.startsWith('TOM') && points.at(-1).x);
        const {xaxis, yaxis} = plot._fullLayout, point = trace.at(-1);
        return [xaxis.l2p(point.x), yaxis.l2p(point.y)];
    }"""
    frame = present(chart.locator(".nsewdrag").first.bounding_box())
    x, y = chart.evaluate(place)
    page.mouse.click(frame["x"] + x, frame["y"] + y)
    page.wait_for_url("**/curves?*run=*pendulum-tom-*")


def click_the_first_fit(page: "Page", store: Path) -> None:
    chart = page.locator(".js-plotly-plot").first
    chart.locator(".hm").wait_for()
    page.evaluate(CALM)  # a chart that moves is not where it was
    frame = present(chart.locator(".nsewdrag").first.bounding_box())
    page.mouse.click(frame["x"] + 0.02 * frame["width"], frame["y"] + 0.5 * frame["height"])
    page.wait_for_url("**/attention?*step=*")
    chosen, run = int(asked(page)["step"][0]), asked(page)["run"][0]
    assert chosen == RunReader(store / run).profiles().env_step[0]
    page.locator(".readout dd").first.get_by_text(f"{chosen:,}", exact=True).wait_for()


def see_runs_side_by_side(page: "Page") -> None:
    """The returns lie in the drawn part of their axes, which the weights' axes stand above."""
    page.get_by_role("radio", name="Side by side").click()
    chart = page.get_by_role("group", name="weights and return of the runs")
    chart.locator(".nsewdrag").first.wait_for()
    lines = chart.evaluate("""plot => plot._fullData.filter(t => t.name.endsWith("return")).map(
        ({ y, yaxis }) => [
            plot._fullLayout[yaxis.replace("y", "yaxis")].range, Math.min(...y), Math.max(...y),
        ])""")
    assert len(lines) >= 2
    assert all(low <= least <= most <= high for (low, high), least, most in lines)


def play_an_episode(page: "Page") -> None:
    """The scene's clock moves the cursor of the charts, once somebody has said that it shall."""
    wait_until_drawn(page.locator("iframe"), 0.001)
    cursor = "plot => plot.layout.shapes[0].x0"
    chart = page.locator(".js-plotly-plot").nth(1)
    chart.locator(".nsewdrag").first.wait_for()
    before = chart.evaluate(cursor)
    page.locator(".st-key-replay-play button").click()
    until(page, lambda: chart.evaluate(cursor) != before, f"the replay stands at {before}")


def see_it_in_rerun(page: "Page") -> None:
    """The same episode, made into a recording when it is asked for."""
    with page.expect_response("**/episode-*.rrd") as answer:
        page.get_by_role("radio", name="Rerun").last.click()
    assert answer.value.ok
    # Only the scene: the viewer's buttons and its curve are coloured without any robot.
    wait_until_drawn(page.locator("iframe"), 0.002, top=0.65)


WATCH = """() => {
  window.seen = [];
  window.addEventListener("tom:step", ({ detail }) => {
    const plots = [...document.querySelectorAll(".plot")];
    const [profile] = plots.filter((p) => p.follows?.trace);
    const [heat] = plots.filter((p) => p.follows?.cursor);
    const line = heat.parentElement.querySelector(".plot-cursor");
    const xaxis = heat._fullLayout?.xaxis; // not yet, where the chart is still to be drawn
    const place = line.getBoundingClientRect().left - heat.getBoundingClientRect().left;
    seen.push({
      step: detail, fit: document.querySelector(".readout dd").textContent,
      profile: [...(profile.data?.[0].y ?? [])], address: location.search,
      // in steps, back from where the line is seen
      cursor: xaxis?.p2d(place - xaxis._offset), pixel: xaxis && xaxis.p2d(2) - xaxis.p2d(0),
    });
  });
}"""
"""notes what stands on the page at every step of the timeline, in the same turn of the browser"""


def seen(page: "Page") -> list[dict]:
    return page.evaluate("window.seen")


def moved(page: "Page", key: str) -> dict:
    """What the page shows as soon as a key has moved the timeline."""
    before = len(seen(page))
    page.keyboard.press(key)
    until(page, lambda: len(seen(page)) > before, f"{key} moves nothing")
    return seen(page)[before]


@pytest.mark.quick
def test_the_timeline_moves_numbers_and_profile_before_the_server_hears_of_it(
    visit: Visit,
    store: Path,
) -> None:
    run = RunReader(store / PENDULUM_TOM)
    profiles = run.profiles()
    fits = profiles.env_step.tolist()
    stops = sorted({*fits, *run.evaluation_steps()})
    page = visit.page
    page.goto(visit.links.user_address(f"attention?run={PENDULUM_TOM}"))
    for i in range(2):
        page.locator(".js-plotly-plot").nth(i).locator(".nsewdrag").first.wait_for()
    page.evaluate(WATCH)
    for at in range(len(stops) - 2, -1, -1):
        shown = moved(page, "ArrowLeft")
        fit = at_or_before(fits, stops[at])
        assert (shown["step"], shown["fit"]) == (stops[at], f"{fit:,}")
        assert shown["cursor"] == pytest.approx(stops[at], abs=shown["pixel"])
        expected = profiles.bins[fits.index(fit)]
        assert np.array(shown["profile"]) == pytest.approx(expected, rel=6e-3)
        if at == len(stops) - 2:
            assert "step" not in shown["address"]
    settle(page, f"step={stops[0]}")
    number = page.locator(".readout dd").first
    until(page, lambda: number.inner_text() == f"{fits[0]:,}", "the server's fit is another")
    assert moved(page, "ArrowRight")["step"] == stops[1]
    settle(page, f"step={stops[1]}" if len(stops) > 2 else f"run={PENDULUM_TOM}")
    page.go_back()
    page.wait_for_url(lambda address: f"step={stops[0]}" in address)
    until(page, lambda: seen(page)[-1]["step"] == stops[0], "Back leaves the timeline")
    before = len(seen(page))
    page.get_by_role("button", name="Play", exact=True).click()
    page.wait_for_url(lambda address: "step" not in address)  # the end is where it stands usually
    played = [one["step"] for one in seen(page)[before:]]  # by the clock: a slow browser leaves out
    played = played[: played.index(stops[-1]) + 1]
    assert played[0] == stops[0]
    assert played == sorted({*played} & {*stops})
    assert page.locator(".timeline output").inner_text() == f"step {stops[-1]:,}"
    page.get_by_role("button", name="Play", exact=True).wait_for()  # and no longer Pause


def test_back_takes_back_one_choice_after_the_other(visit: Visit) -> None:
    page = visit.page
    page.goto(visit.links.user_address(START))
    drawn(page)
    page.get_by_role("radio", name="Statistics").click()
    settle(page, "part=Statistics")
    page.get_by_role("radio", name="Curves").click()
    page.wait_for_url(lambda address: "part=" not in address)
    drawn(page)
    page.get_by_role("button", name="Lines", exact=True).click()
    page.get_by_text("log y").click()
    settle(page, "logy=true")
    page.go_back()
    page.wait_for_url(lambda address: "logy" not in address)
    drawn(page)
    assert asked(page) == {"task": ["inverted-pendulum"]}
    page.go_back()
    page.get_by_text("Performance profile").wait_for()
    assert page.get_by_role("radio", name="Statistics").is_checked()
    page.go_back()
    page.get_by_text("1000 resamples").wait_for()
    assert page.get_by_role("radio", name="Curves").is_checked()
    visit.open("Attention", "attention")
    shown, busy = page.get_by_text("Every fit"), page.get_by_test_id("stStatusWidget")
    # At rest: a picture asked for after its page was left is gone, which the console would tell.
    wait_until_steady(page, lambda: shown.count() > 0 and not busy.count(), 1)
    page.go_back()
    page.get_by_text("1000 resamples").wait_for()
    assert asked(page) == {"task": ["inverted-pendulum"]}


# The buffer's map: it chooses the rows that the server chooses

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
    visit.page.goto(visit.links.user_address(f"attention?run={PENDULUM_TOM}&step=300&{words}"))
    visit.page.locator(".buffer-map[data-loaded]").wait_for()
    filters = len(query.get("where", [])) + len(query.get("outline", []))
    applied = f"document.querySelector('.buffer-map').rows?.bits.size === {filters}"
    until(visit.page, lambda: visit.page.evaluate(applied), "not all filters were applied")
    return visit.page


def on_the_server(store: Path, where: list[str], outline: list[str]) -> list[int]:
    run = RunReader(store / PENDULUM_TOM)
    source = buffer_map.sources(run)["300"]
    mask = buffer_map.selection_mask(run, source, Selection.of(where, outline))
    return (source.first + np.flatnonzero(mask)).tolist()


def test_browser_and_server_choose_the_same_rows(visit: Visit, store: Path) -> None:
    sizes = set()
    for case in CASES:
        page = opened(visit, **case)
        expected = on_the_server(store, case.get("where", []), case.get("outline", []))
        assert page.evaluate(CHOSEN) == expected
        sizes.add(len(expected))
    assert len(sizes) > 2


@pytest.mark.quick
def test_a_brush_a_lasso_and_back(visit: Visit, store: Path) -> None:
    page = opened(visit)
    canvas = page.locator(".map-hist[data-name='pole angle'] canvas")
    canvas.scroll_into_view_if_needed()
    box = present(canvas.bounding_box())
    y = box["y"] + box["height"] / 2
    page.mouse.move(box["x"] + 0.3 * box["width"], y)
    page.mouse.down()
    page.mouse.move(box["x"] + 0.6 * box["width"], y, steps=5)
    page.mouse.up()
    page.wait_for_url("**/attention?*where=*")

    def agree() -> bool:
        words = asked(page)
        expected = on_the_server(store, words.get("where", []), words.get("outline", []))
        return page.evaluate(CHOSEN) == expected

    until(page, agree, "browser and server choose other rows")
    brushed = page.evaluate(CHOSEN)
    map_box = present(page.locator(".map-over").bounding_box())
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
    store: Path,
) -> None:
    first, last = (
        buffer_map.fit_sources(RunReader(store / PENDULUM_TOM))[fit] for fit in ("200", "300")
    )
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


def test_a_choice_that_is_made_again_counts_again(visit: Visit) -> None:
    page = opened(visit)
    for _ in range(2):
        page.get_by_role("slider", name="Step of the training").focus()
        page.keyboard.press("Home")
        page.wait_for_url("**/attention?*step=200*")
        page.go_back()
        until(page, lambda: asked(page).get("step") != ["200"], "Back keeps the step")
    page.evaluate(CALM)
    page.get_by_label("Colour").focus()
    page.keyboard.press("a")  # a real key: Back forgets what a script alone did
    page.wait_for_url("**/attention?*colour=age*")
    page.evaluate(CALM)
    page.go_back()
    colour = "document.querySelector('.buffer-map')?.colour"
    until(page, lambda: page.evaluate(colour) == "weight", "Back keeps the colour")
    fold = page.locator("summary", has_text="The chosen transitions")
    fold.focus()
    page.keyboard.press("Space")
    page.locator("details[open]", has_text="The chosen transitions").wait_for()
    assert page.get_by_role("button", name="Play", exact=True).first.is_visible()


def test_every_figure_can_be_saved_after_another(visit: Visit) -> None:
    visit.page.goto(visit.links.user_address("curves?task=inverted-pendulum"))
    charts = visit.page.locator(".js-plotly-plot")
    for i in (0, 1, 0):
        charts.nth(i).locator(".nsewdrag").first.wait_for()
        charts.nth(i).get_by_role("button", name="Save: SVG, PDF, PNG, CSV").press("Enter")
        box = visit.page.locator("dialog[open]")
        with visit.page.expect_download():
            box.get_by_role("button", name="SVG").click()
        box.get_by_role("button", name="Close").click()
