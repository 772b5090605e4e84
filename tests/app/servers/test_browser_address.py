"""What a visitor sees is in the address: for another tab, a reload, and Back."""

import json
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from studio_browser import (
    LOCAL,
    NEEDS_BROWSER,
    Visit,
    asked,
    drawn,
    lines,
    named,
    settle,
    shown_steps,
    until,
    wait_until_steady,
    zoom_in,
)
from studio_runs import PENDULUM_TOM

from tom.record.reader import RunReader

if TYPE_CHECKING:
    from playwright.sync_api import Page

pytestmark = NEEDS_BROWSER
START = "curves?task=inverted-pendulum"
HOSTILE = "<img src=http://evil.example/x.png onerror=alert(1)>"


def same_steps(page: "Page", zoomed: list[float]) -> None:
    """Every panel shows these steps."""
    panels = page.locator(".js-plotly-plot").all()
    assert len(panels) > 1
    for panel in panels:
        assert shown_steps(panel) == pytest.approx(zoomed, rel=1e-4)


def counted(page: "Page", label: str) -> None:
    """Wait until the first chart has a line of this name."""
    until(page, lambda: label in named(page), f"no {label}")


def test_what_is_hidden_and_zoomed_is_in_the_address_and_back_goes_back(visit: Visit) -> None:
    page = visit.page
    page.goto(visit.links.opened(START))
    all_steps = shown_steps(drawn(page))
    page.get_by_role("button", name="Hide MLE", exact=True).click()
    settle(page, "hide=MLE")
    assert lines(page) == {"TOM"}
    zoomed = zoom_in(drawn(page))
    settle(page, "zoom=")
    same_steps(page, zoomed)
    page.locator(".runlist .head .name", has_text="TOM").click()
    page.locator(".runlist .run .eye").last.click()
    settle(page, "hide=pendulum-tom-1")
    counted(page, "TOM (1 seed, no band)")
    same_steps(page, zoomed)  # a redraw keeps it
    shared = page.url

    browser = page.context.browser
    assert browser is not None
    second = browser.new_page(viewport={"width": 1280, "height": 1000})  # somebody else's
    second.goto(visit.links.opened(shared.removeprefix(f"{visit.links.address}/")))
    counted(second, "TOM (1 seed, no band)")
    assert lines(second) == {"TOM"}
    same_steps(second, zoomed)
    second.wait_for_url(shared)
    second.get_by_role("button", name="Show all").click()
    second.wait_for_url(lambda address: "hide=" not in address)
    counted(second, "TOM (n = 2)")
    until(second, lambda: lines(second) == {"MLE", "TOM"}, "MLE is not shown again")
    box = drawn(second).locator(".nsewdrag").first.bounding_box()
    assert box is not None
    second.mouse.dblclick(box["x"] + 0.5 * box["width"], box["y"] + 0.5 * box["height"])
    second.wait_for_url(lambda address: "zoom=" not in address)
    assert shown_steps(drawn(second)) == pytest.approx(all_steps)
    second.close()

    page.reload()
    counted(page, "TOM (1 seed, no band)")
    same_steps(page, zoomed)
    page.go_back()
    page.wait_for_url(lambda address: "pendulum-tom-1" not in address)
    counted(page, "TOM (n = 2)")
    same_steps(page, zoomed)
    page.go_back()
    page.wait_for_url(lambda address: "zoom=" not in address)
    page.wait_for_timeout(1500)
    assert shown_steps(drawn(page)) == pytest.approx(all_steps)
    assert lines(page) == {"TOM"}
    page.go_forward()
    page.wait_for_url(lambda address: "zoom=" in address)
    page.wait_for_timeout(1500)
    same_steps(page, zoomed)


@pytest.mark.quick
def test_back_takes_back_one_choice_after_the_other(visit: Visit) -> None:
    page = visit.page
    page.goto(visit.links.opened(START))
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


def test_back_takes_back_a_step_and_a_run_and_no_correction(visit: Visit) -> None:
    page, links = visit.page, visit.links
    run = RunReader(Path(links.store) / PENDULUM_TOM)
    fits = run.profiles().env_step.tolist()
    first, second, *_ = sorted({*fits, *run.evaluation_steps()})

    def at(step: int) -> None:
        page.locator(".timeline output").get_by_text(f"step {step:,}", exact=True).wait_for()
        page.wait_for_timeout(1500)

    page.goto(links.opened(START))
    drawn(page)
    entries = page.evaluate("history.length")
    page.goto(f"{links.address}/attention?run={PENDULUM_TOM}&step={first + 1}")
    settle(page, f"step={first}")  # the one before
    page.locator(".timeline input").press("ArrowRight")
    at(second)
    chosen = asked(page)
    page.locator(".runlist .head .name", has_text="MLE").click()
    page.locator(".runlist .group", has_text="MLE").locator(".run .name").click()
    settle(page, "run=pendulum-mle-0")
    elsewhere = asked(page)
    visit.open("Replays", "replays")
    settle(page, "run=pendulum-mle-0")
    assert page.evaluate("history.length") == entries + 4
    page.go_back()
    page.wait_for_url(lambda address: "attention" in address and asked(page) == elsewhere)
    page.wait_for_timeout(1500)
    page.go_back()
    page.wait_for_url(lambda address: asked(page) == chosen)
    at(second)
    page.go_back()
    at(first)
    assert asked(page) == {"run": [PENDULUM_TOM], "step": [str(first)]}
    page.go_forward()
    at(second)
    page.reload()
    at(second)
    page.go_back()
    page.wait_for_timeout(1500)
    page.go_back()
    drawn(page)
    assert asked(page) == {"task": ["inverted-pendulum"]}


def test_hostile_words_are_plain_words_in_the_list_of_runs(visit: Visit, own: Path) -> None:
    path = own / PENDULUM_TOM / "config.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"learner": HOSTILE}))
    page = visit.page
    page.goto(visit.links.opened(START))
    title = page.locator(".runlist .head .name").get_by_text(HOSTILE)
    title.click()
    page.locator(".runlist .run .name").first.wait_for()
    assert page.locator(".runlist img").count() == 0
    assert visit.asked <= LOCAL
