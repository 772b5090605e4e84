"""The ten things that a visitor comes for, by keyboard alone from the first key to the last."""

import json
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
from studio_browser import (
    CALM,
    DRAWN_S,
    NEEDS_BROWSER,
    drawn,
    lines,
    studio,
    until,
    wait_until_drawn,
)
from studio_runs import PENDULUM_TOM, ROAD_MLE, ROAD_TOM

from app.data import trainings
from app.links import Links
from tom.record import manage
from tom.record.store import Store

if TYPE_CHECKING:
    from playwright.sync_api import Browser, Locator, Page

pytestmark = NEEDS_BROWSER
MOST_TABS = 250
"""key presses from the beginning of a page to its end"""
MOST_ARROWS = 8
SEEN = """() => {
    let at = document.activeElement;
    if (at.matches("input:not([type=checkbox], [type=radio], [type=range]), textarea")) return true;
    if (document.querySelector(".timeline:has(input:focus-visible)")) return true;
    for (; at !== document.body; at = at.parentElement) {
        const { outlineStyle, boxShadow } = getComputedStyle(at);
        if (outlineStyle !== "none" || boxShadow !== "none") return true;
    }
    return false;
}"""
"""whether a ring tells where the focus is, or the mark of a text"""


@pytest.fixture(scope="module")
def own_store(tmp_path_factory: pytest.TempPathFactory, store: Path) -> Path:
    """A copy of the recorded runs that the visitors may change."""
    return shutil.copytree(store, tmp_path_factory.mktemp("visitor") / "store")


@pytest.fixture(scope="module")
def links(own_store: Path, browser: "Browser") -> Iterator[Links]:
    with studio(own_store, browser) as links:
        yield links


@pytest.fixture
def page(links: Links, browser: "Browser", own_store: Path) -> Iterator["Page"]:
    page = browser.new_page(viewport={"width": 1280, "height": 1000}, base_url=links.address)
    page.set_default_timeout(1000 * DRAWN_S)
    page.goto(links.user_address())
    yield page
    page.close()
    for run in Store(own_store).runs():
        if run.status.alive:
            trainings.stop(Store(own_store), run.run_id)


def reach(element: "Locator") -> None:
    """Press Tab until `element`, or something in it, has the focus, and shows it."""
    page = element.page
    element.wait_for()
    for _ in range(MOST_TABS):
        page.keyboard.press("Tab")
        if element.evaluate("e => e.contains(document.activeElement)"):
            assert page.evaluate(SEEN), "nothing shows where the focus is"
            return
    pytest.fail(f"Tab does not come to {element}")


def press(element: "Locator", key: str = "Enter") -> None:
    reach(element)
    element.page.keyboard.press(key)


def choose(page: "Page", label: str, option: str) -> None:
    """Type an option of a select box, and take it, once nothing on the page changes any more."""
    page.evaluate(CALM)
    reach(page.get_by_role("combobox", name=label).first)
    page.keyboard.type(option)
    page.get_by_role("option", name=option, exact=True).first.wait_for()
    page.keyboard.press("Enter")


def take(page: "Page", name: str) -> None:
    """Go by arrows to one of several buttons of which one is down, and press it."""
    one = page.get_by_role("radio", name=name)
    one.wait_for()
    reach(page.get_by_role("radiogroup").filter(has=one))
    for key in (*MOST_ARROWS * ("ArrowRight",), *MOST_ARROWS * ("ArrowLeft",)):
        if one.evaluate("e => e === document.activeElement"):
            page.keyboard.press("Space")
            return
        page.keyboard.press(key)
    pytest.fail(f"no arrow leads to {name}")


@pytest.mark.quick
def test_a_training_is_started_watched_and_stopped(page: "Page", own_store: Path) -> None:
    before = {run.run_id for run in Store(own_store).runs()}
    press(page.locator("summary", has_text="Start a training"))
    choose(page, "Environment", "inverted-pendulum")
    choose(page, "Preset", "smoke")
    steps = page.get_by_role("spinbutton", name="Steps")
    until(page, lambda: steps.count() == 1 and steps.input_value() == "600", "not the preset's")
    reach(steps)
    page.keyboard.press("Control+a")
    page.keyboard.type("50000\n")
    page.locator("code", has_text="--steps=50000").wait_for()
    press(page.get_by_role("button", name="Start", exact=True))
    stop = page.get_by_role("button", name="Stop", exact=True)
    stop.wait_for()
    [run] = [run for run in Store(own_store).runs() if run.run_id not in before]
    until(page, lambda: run.evaluation_steps(), "the training was never evaluated")
    press(stop)
    page.locator("code", has_text=f"tom train --resume {run.run_id}").wait_for()
    press(page.get_by_role("button", name="Stop this training"))
    stop.wait_for(state="detached")  # at once: the training ends after its step
    until(
        page, lambda: Store(own_store).run(run.run_id).status.shown == "stopped", "it did not stop"
    )


def test_a_comparison_is_made_and_shared(page: "Page") -> None:
    page.goto("/curves?task=inverted-pendulum")
    until(page, lambda: lines(page) == {"TOM", "MLE"}, "not all lines")
    eye = page.locator(".runlist .head .eye[aria-label*=MLE]")
    press(eye, "Space")
    until(page, lambda: lines(page) == {"TOM"}, "the line is still there")
    assert eye.evaluate("e => e === document.activeElement")  # after the drawing
    press(page.get_by_role("button", name="Link"))
    press(page.get_by_role("button", name="Make a short link"))
    link = page.get_by_text("/v/").first
    link.wait_for()
    page.goto(link.inner_text())
    until(page, lambda: lines(page) == {"TOM"}, "another view")


def test_a_region_is_seen_as_robots_and_brushed(page: "Page", own_store: Path) -> None:
    page.goto(f"/attention?run={PENDULUM_TOM}")
    press(page.get_by_role("button", name="Weight zero"))
    page.wait_for_url("**/attention?*where=*")
    before = page.url
    press(page.get_by_role("button", name="Heaviest 1 %"))
    page.wait_for_url(lambda url: "where=" in url and url != before)
    page.frame_locator("iframe").first.get_by_text("Heavy and light").wait_for()
    press(page.get_by_role("button", name="Fit small models"))
    page.get_by_role("combobox", name="Brushed").wait_for(timeout=3000 * DRAWN_S)
    reports = [json.loads(path.read_text()) for path in own_store.glob("weighings/*/report.json")]
    assert sum("brush" in report for report in reports) == 1


def test_every_learner_weighs_one_buffer(page: "Page", own_store: Path) -> None:
    page.goto(f"/attention?run={PENDULUM_TOM}")
    take(page, "Every learner on one buffer")
    press(page.get_by_role("button", name="Weigh", exact=True))
    page.get_by_text("The weights in numbers").wait_for(timeout=3000 * DRAWN_S)
    reports = [json.loads(path.read_text()) for path in own_store.glob("weighings/*/report.json")]
    assert sum("brush" not in report for report in reports) == 1


def test_a_replay_is_reached_from_a_curve(page: "Page") -> None:
    page.goto("/curves?task=inverted-pendulum")
    press(page.locator(".runlist .head .name", has_text="MLE"))
    press(page.locator(".runlist .run .name").first, "Space")
    page.wait_for_url("**/curves?*run=pendulum-mle-0*")
    press(page.get_by_role("link", name="Replays").first)
    page.wait_for_url("**/replays?*run=pendulum-mle-0*")
    wait_until_drawn(page.locator("iframe").first, 0.001)
    cursor = "plot => plot.layout.shapes[0].x0"
    chart = page.locator(".js-plotly-plot").nth(1)
    before = chart.evaluate(cursor)
    press(page.locator(".st-key-replay-play button"))
    until(page, lambda: chart.evaluate(cursor) != before, "the replay stands still")


def test_two_roads_stand_side_by_side(page: "Page") -> None:
    page.goto(f"/attention?run={ROAD_TOM}")
    page.get_by_label("Side by side with").first.wait_for()
    choose(page, "Side by side with", "Road and rocks · MLE · seed 0")
    page.wait_for_url(f"**/attention?*beside={ROAD_MLE}*")
    page.locator(".js-plotly-plot:has(.heatmaplayer)").nth(1).wait_for()


def test_a_weight_is_explained(page: "Page", own_store: Path) -> None:
    page.goto(f"/attention?run={PENDULUM_TOM}")
    heaviest = page.get_by_role("button", name="heaviest", exact=True)
    press(heaviest, "Space")
    page.locator('.js-plotly-plot[aria-label*="terms that make"]').wait_for()
    page.evaluate(CALM)
    assert heaviest.evaluate("e => e === document.activeElement")
    number = page.get_by_role("spinbutton", name="Number of the transition").input_value()
    run = Store(own_store).run(PENDULUM_TOM)
    fit = run.snapshot_steps()[-1]
    weight = run.snapshot(fit)["weight"].to_numpy()
    assert weight[int(number) - (fit - len(weight))] == weight.max()


def test_a_figure_and_a_film_are_taken_home(page: "Page", tmp_path: Path) -> None:
    page.goto("/curves?task=inverted-pendulum")
    drawn(page)
    press(page.get_by_role("button", name="Save: SVG, PDF, PNG, CSV").first)
    box = page.get_by_role("dialog", name="Save this figure")
    for kind in ("CSV", "SVG", "PDF"):
        with page.expect_download() as download:
            press(box.get_by_role("button", name=kind))
        assert download.value.path().stat().st_size > 100
    page.keyboard.press("Escape")
    box.wait_for(state="hidden")
    page.goto(f"/replays?run={PENDULUM_TOM}")
    take(page, "Film")
    with page.expect_download() as download:
        page.frame_locator("iframe").last.get_by_role("button", name="MP4").click()
    assert download.value.path().read_bytes()[4:8] == b"ftyp"
    with page.expect_download() as download:
        press(page.get_by_role("button", name="One HTML file"))
    film = download.value.path().read_bytes()
    assert film.lower().startswith(b"<!doctype html")
    assert len(film) > 10_000


def test_a_run_is_labelled_put_into_the_trash_and_brought_back(
    page: "Page", own_store: Path
) -> None:
    store = Store(own_store)
    page.goto("/curves?task=inverted-pendulum")
    take(page, "Runs")
    choose(page, "Runs to label or to move to the trash", "pendulum-tom-1")
    page.keyboard.press("Escape")
    reach(page.get_by_label("Name", exact=True))
    page.keyboard.type("the steady one")
    press(page.get_by_role("button", name="Save"))
    until(page, lambda: store.run("pendulum-tom-1").labels.name, "no name was kept")
    press(page.get_by_role("button", name="Move it to the trash"))
    move = page.get_by_role("button", name="Yes, move it")
    press(move)
    move.wait_for(state="detached")
    assert page.evaluate("document.activeElement !== document.body")
    assert manage.trashed(store) == ["pendulum-tom-1"]
    press(page.locator("summary", has_text="1 in the trash"))
    page.evaluate(CALM)
    choose(page, "Runs to bring back", "pendulum-tom-1")
    bring_back = page.get_by_role("button", name="Bring back", include_hidden=True)
    until(page, bring_back.is_enabled, "the choice was not taken")
    page.keyboard.press("Escape")
    press(bring_back)
    page.get_by_text("1 in the trash").wait_for(state="detached")
    assert store.run("pendulum-tom-1").labels.name == "the steady one"


def test_a_search_by_slash_and_help_by_question_mark(page: "Page") -> None:
    page.goto("/curves")
    page.locator(".runlist .section").first.wait_for()
    page.wait_for_load_state("networkidle")
    page.keyboard.press("/")
    assert page.evaluate("document.activeElement.matches('[data-testid=stSidebar] input')")
    page.keyboard.press("Escape")
    page.evaluate("document.activeElement.blur()")
    page.keyboard.press("?")
    page.get_by_role("dialog", name="Shortcuts").wait_for()
    page.keyboard.press("Escape")
    page.get_by_role("dialog", name="Shortcuts").wait_for(state="hidden")


@pytest.mark.parametrize("path", ["", "curves", "attention", "replays", "findings"])
def test_a_page_has_headings_in_order_and_names(page: "Page", path: str) -> None:
    page.goto(f"/{path}?task=inverted-pendulum")
    page.locator(".runlist .section").wait_for()
    page.locator("h1").wait_for()
    page.wait_for_timeout(2000)
    levels = page.evaluate(
        "() => [...document.querySelectorAll('[data-testid=stMain] :is(h1,h2,h3,h4)')]"
        ".map(({ tagName }) => Number(tagName[1]))"
    )
    assert levels.count(1) == 1
    assert levels[0] == 1
    assert (np.diff(levels) <= 1).all()
    task = page.title().split(" - ")
    assert task[-1] == "TOM Studio"
    assert len(task) == 3
    nameless = page.evaluate(
        """() => [...document.querySelectorAll("button, a, input, iframe, [role=slider]")].filter(
            (e) => e.offsetParent && !e.innerText?.trim() && !e.ariaLabel && !e.title
                && !e.labels?.length && !e.getAttribute("aria-labelledby")
        ).map((e) => e.outerHTML.slice(0, 200))"""
    )
    assert nameless == []
