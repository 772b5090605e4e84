"""What a visitor comes for, done in a real browser from the first click to the last."""

import io
import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from PIL import Image
from studio_runs import PENDULUM_TOM, ROAD_MLE, ROAD_TOM
from test_browser import DRAWN_S, Visit, drawn, wait_until_drawn

from app.links import Links
from tom.record import manage
from tom.record.status import Status
from tom.record.store import Store

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Locator, Page

pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(shutil.which("chromium") is None, reason="needs Debian's chromium"),
]


@pytest.fixture
def visitor(opened: tuple[Links, "Browser"]) -> Iterator[Visit]:
    """A tab of their own."""
    links, browser = opened
    page = browser.new_page(viewport={"width": 1280, "height": 1000})
    page.set_default_timeout(1000 * DRAWN_S)
    yield Visit(page, links)
    page.close()


def choose(page: "Page", label: str, option: str) -> None:
    """Take an option of a select box or multiselect, again if the click fell into a redraw."""
    from playwright.sync_api import TimeoutError

    for _ in range(4):
        page.get_by_role("combobox", name=label).first.click()
        try:
            page.get_by_role("option", name=option, exact=True).first.click(timeout=10_000)
            return
        except TimeoutError:
            page.keyboard.press("Escape")
    pytest.fail(f"{option} of {label} could not be taken")


def click_in(chart: "Locator", x: float, y: float) -> None:
    """A click at a share of a chart's width and height, from its top left corner."""
    frame = chart.locator(".nsewdrag").first.bounding_box()
    assert frame is not None
    chart.page.mouse.click(frame["x"] + x * frame["width"], frame["y"] + y * frame["height"])


def until(page: "Page", holds, what: str) -> None:
    """Wait until something holds that no element of the page tells."""
    deadline = time.monotonic() + DRAWN_S
    while not holds():
        assert time.monotonic() < deadline, what
        page.wait_for_timeout(200)


def status(store: Path, run_id: str) -> Status:
    """The status as it is now; a reader keeps the one that it read first."""
    return Store(store).run(run_id).status


def picture(element: "Locator") -> np.ndarray:
    """The pixels of an element: (height, width, 3)."""
    return np.asarray(Image.open(io.BytesIO(element.screenshot())).convert("RGB"))


@pytest.mark.quick
@pytest.mark.usefixtures("no_training_left")
def test_starts_a_training_watches_it_and_stops_it(visitor: Visit, own_store: Path) -> None:
    before = {run.run_id for run in Store(own_store).runs()}
    page = visitor.page
    page.goto(visitor.links.opened())
    page.get_by_text("Start a training").click()
    choose(page, "Environment", "inverted-pendulum")
    choose(page, "Preset", "smoke")
    steps = page.get_by_role("spinbutton", name="Steps")
    until(page, lambda: steps.count() == 1 and steps.input_value() == "600", "not the preset's")
    steps.fill("50000")
    steps.press("Enter")
    page.locator("code", has_text="--steps=50000").wait_for()
    page.get_by_role("button", name="Start", exact=True).click()
    stop = page.get_by_role("button", name="Stop", exact=True)
    stop.wait_for()
    [run] = [run for run in Store(own_store).runs() if run.run_id not in before]
    until(page, lambda: run.evaluation_steps(), "the training was never evaluated")
    stop.click()
    page.locator("code", has_text=f"tom train --resume {run.run_id}").wait_for()
    page.get_by_role("button", name="Stop this training").click()
    stop.wait_for(state="detached")  # at once: the training ends after its step
    until(page, lambda: status(own_store, run.run_id).shown == "stopped", "it did not stop")
    run = Store(own_store).run(run.run_id)
    assert 0 < run.status.env_step < 50_000
    assert (run.path / "checkpoint").is_dir()


def test_weighs_a_buffer_and_reads_the_profiles(visitor: Visit) -> None:
    page = visitor.page
    page.goto(visitor.links.opened(f"probe?run={PENDULUM_TOM}"))
    page.get_by_text("Nobody has weighed this buffer yet").wait_for()
    page.get_by_role("button", name="Weigh", exact=True).click()
    page.get_by_text("What the weights come to").wait_for()
    names = "plot => plot.data.map(trace => trace.name || '').join()"
    drawn = page.locator(".js-plotly-plot").first.evaluate(names)
    assert all(learner in drawn for learner in ("TOM", "PMAC", "MLE"))


def test_sees_the_replay_of_a_point_of_a_curve(visitor: Visit) -> None:
    page = visitor.page
    page.goto(visitor.links.opened("curves?task=inverted-pendulum"))
    chart = drawn(page)
    place = """plot => {
        const trace = plot.calcdata.findLast(points => points[0].trace.mode?.includes('lines')
            && points[0].trace.name?.startsWith('TOM') && points.at(-1).x);
        const {xaxis, yaxis} = plot._fullLayout, point = trace.at(-1);
        return [(xaxis.l2p(point.x)) / xaxis._length, yaxis.l2p(point.y) / yaxis._length];
    }"""
    click_in(chart, *chart.evaluate(place))
    page.wait_for_url("**/curves?*run=*pendulum-tom-*")
    visitor.open("Replays", "replays")
    page.wait_for_url("**/replays?*run=*pendulum-tom-*")
    wait_until_drawn(page.locator("iframe").first, 0.001)


def test_sets_two_roads_side_by_side(visitor: Visit) -> None:
    page = visitor.page
    page.goto(visitor.links.opened(f"road?run={ROAD_TOM}"))
    page.get_by_label("Side by side with").first.wait_for()
    choose(page, "Side by side with", "Road and rocks · MLE · seed 0")
    page.wait_for_url(f"**/attention?*beside={ROAD_MLE}*")
    maps = page.locator(".js-plotly-plot:has(.heatmaplayer)")
    maps.nth(1).wait_for()
    scale = """plot => {
        const {coloraxis} = plot._fullLayout, {trace} = plot.calcdata[0][0];
        return [coloraxis?.cmin ?? trace.zmin, coloraxis?.cmax ?? trace.zmax];
    }"""
    scales = [chart.evaluate(scale) for chart in maps.all()]
    assert len(scales) == 2
    assert scales[0] == scales[1]
    wait_until_drawn(page.locator("iframe").first, 0.03)


def test_labels_a_run_and_moves_it_to_the_trash_and_back(visitor: Visit, own_store: Path) -> None:
    page, store = visitor.page, Store(own_store)
    page.goto(visitor.links.opened("curves?part=Runs&task=inverted-pendulum"))
    choose(page, "Runs to label or to move to the trash", "pendulum-tom-1")
    page.get_by_label("Name", exact=True).fill("the steady one")
    page.get_by_role("button", name="Save").click()
    until(page, lambda: store.run("pendulum-tom-1").labels.name, "no name was kept")
    assert store.run("pendulum-tom-1").labels.name == "the steady one"
    page.get_by_role("button", name="Move it to the trash").click()
    move = page.get_by_role("button", name="Yes, move it")
    move.click()
    move.wait_for(state="detached")  # drawn anew: what is chosen before would be lost
    page.get_by_text("1 in the trash").click()
    assert manage.trashed(store) == ["pendulum-tom-1"]
    bring_back = page.get_by_role("button", name="Bring back", include_hidden=True)
    choose(page, "Runs to bring back", "pendulum-tom-1")
    until(page, bring_back.is_enabled, "the choice was not taken")
    page.keyboard.press("Escape")
    bring_back.click()
    page.get_by_text("1 in the trash").wait_for(state="detached")
    assert store.run("pendulum-tom-1").labels.name == "the steady one"


def test_takes_a_cinema_home(
    visitor: Visit, opened: tuple[Links, "Browser"], tmp_path: Path
) -> None:
    page = visitor.page
    page.goto(visitor.links.opened(f"cinema?run={PENDULUM_TOM}&length=15+s"))
    with page.expect_download() as download:
        page.frame_locator("iframe").last.get_by_role("button", name="MP4").click()
    assert download.value.suggested_filename.endswith(".mp4")
    assert download.value.path().read_bytes()[4:8] == b"ftyp"
    with page.expect_download() as download:
        page.get_by_role("button", name="One HTML file").click()
    film = tmp_path / "film.html"
    download.value.save_as(film)
    context = opened[1].new_context(offline=True)
    home = context.new_page()
    outside: list[str] = []
    home.on("request", lambda asked: outside.extend([asked.url] * asked.url.startswith("http")))
    home.goto(film.as_uri())
    first = picture(home.locator("canvas"))
    assert (first != first[0, 0]).any(axis=-1).mean() > 0.02  # more than a background
    home.get_by_role("button", name="play or pause").click()
    until(home, lambda: (picture(home.locator("canvas")) != first).any(), "the film stands still")
    assert outside == []
    context.close()
