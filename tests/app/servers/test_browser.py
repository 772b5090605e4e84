"""The studio in a real browser: its frames really draw, nothing fails, nothing goes outside."""

import time
from pathlib import Path
from typing import TYPE_CHECKING

import pandas as pd
import pytest
from studio_browser import DRAWN_S, LOCAL, NEEDS_BROWSER, Visit, asked, drawn, wait_until_drawn
from studio_runs import PENDULUM_TOM, ROAD_TOM, RUNS

from tom.record.reader import RunReader

if TYPE_CHECKING:
    from playwright.sync_api import Page

pytestmark = NEEDS_BROWSER


@pytest.mark.quick
def test_a_visit_to_every_page(visit: Visit, own: Path) -> None:
    page = visit.page
    page.goto(visit.links.opened(f"replays?run={PENDULUM_TOM}&part=Rerun"))
    page.wait_for_url(lambda address: "key" not in address)
    wait_until_drawn(page.locator("iframe").last, 0.03)  # Rerun: the robot, the bars, the curves

    visit.open("Answer", "")
    page.get_by_text("Does it help?").wait_for()
    visit.open("Curves", "curves")
    page.locator(".js-plotly-plot").nth(1).wait_for()
    take_the_table(page)
    click_the_end_of_a_curve(page)
    visit.open("Attention", "attention")
    click_the_first_fit(page, own)
    lasso_a_region(page)
    page.get_by_role("radio", name="Every learner on one buffer").click()
    page.get_by_role("button", name="Weigh", exact=True).wait_for()
    visit.open("Replays", "replays")
    play_an_episode(page)
    see_it_in_rerun(page)
    visit.open("Findings", "findings")
    page.get_by_text("tom reproduce").first.wait_for()
    page.goto(f"{visit.links.address}/road?run={ROAD_TOM}")  # as older studios had it
    wait_until_drawn(page.locator("iframe").first, 0.03)  # viser: columns of weight
    keep_the_chosen_run(visit)
    assert visit.asked <= LOCAL


def take_the_table(page: "Page") -> None:
    with page.expect_download() as download:
        page.get_by_role("button", name="Single runs").click()
    table = pd.read_csv(download.value.path())
    assert set(table["run"]) == {run_id for run_id, env, *_ in RUNS if env == "inverted-pendulum"}


def click_the_end_of_a_curve(page: "Page") -> None:
    chart = drawn(page)
    place = """plot => {
        const trace = plot.calcdata.findLast(points => points[0].trace.mode?.includes('lines')
            && points[0].trace.name?.startsWith('TOM') && points.at(-1).x);
        const {xaxis, yaxis} = plot._fullLayout, point = trace.at(-1);
        return [xaxis.l2p(point.x), yaxis.l2p(point.y)];
    }"""
    frame = chart.locator(".nsewdrag").first.bounding_box()
    assert frame is not None
    x, y = chart.evaluate(place)
    page.mouse.click(frame["x"] + x, frame["y"] + y)
    page.wait_for_url("**/curves?*run=*pendulum-tom-*")


def click_the_first_fit(page: "Page", store: Path) -> None:
    chart = page.locator(".js-plotly-plot").first
    chart.locator(".hm").wait_for()
    frame = chart.locator(".nsewdrag").first.bounding_box()
    assert frame is not None
    page.mouse.click(frame["x"] + 0.02 * frame["width"], frame["y"] + 0.5 * frame["height"])
    page.wait_for_url("**/attention?*step=*")
    chosen, run = int(asked(page)["step"][0]), asked(page)["run"][0]
    assert chosen == RunReader(store / run).profiles().env_step[0]
    page.locator(".readout dd").first.get_by_text(f"{chosen:,}", exact=True).wait_for()


def keep_the_chosen_run(visit: Visit) -> None:
    """Another page shows the run that was chosen on this one."""
    visit.open("Replays", "replays")
    visit.page.wait_for_url(f"**/replays?*run={ROAD_TOM}*")


def lasso_a_region(page: "Page") -> None:
    """A lasso chooses rows in the browser, and then on the server."""
    page.locator(".buffer-map[data-drawn]").wait_for()
    page.locator(".map-over").evaluate("map => map.scrollIntoView({ block: 'center' })")
    frame = page.locator(".map-over").bounding_box()
    assert frame is not None
    corners = [(0.3, 0.3), (0.7, 0.3), (0.7, 0.7), (0.3, 0.7), (0.3, 0.35)]
    places = [(frame["x"] + a * frame["width"], frame["y"] + b * frame["height"])
              for a, b in corners]  # fmt: skip
    page.mouse.move(*places[0])
    page.mouse.down()
    for place in places[1:]:
        page.mouse.move(*place, steps=4)
    page.mouse.up()
    page.wait_for_url("**/attention?*outline=*")
    inside = page.evaluate("Number(document.querySelector('.buffer-map').dataset.rows)")
    assert inside > 0
    page.get_by_role("button", name=f"Fit small models: {inside:,} transitions").wait_for()


def play_an_episode(page: "Page") -> None:
    """The scene's clock moves the cursor of the charts, once somebody has said that it shall."""
    wait_until_drawn(page.locator("iframe"), 0.001)
    cursor = "plot => plot.layout.shapes[0].x0"
    chart = page.locator(".js-plotly-plot").nth(1)
    chart.locator(".nsewdrag").first.wait_for()
    before = chart.evaluate(cursor)
    page.locator(".st-key-replay-play button").click()
    deadline = time.monotonic() + DRAWN_S
    while chart.evaluate(cursor) == before:
        assert time.monotonic() < deadline, f"the replay stands at {before}"
        page.wait_for_timeout(200)


def see_it_in_rerun(page: "Page") -> None:
    """The same episode, made into a recording when it is asked for."""
    with page.expect_response("**/episode-*.rrd") as answer:
        page.get_by_role("radio", name="Rerun").last.click()
    assert answer.value.ok
    # Only the scene: the viewer's buttons and its curve are coloured without any robot.
    wait_until_drawn(page.locator("iframe"), 0.002, top=0.65)
