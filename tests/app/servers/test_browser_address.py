"""What a visitor sees is in the address, and its charts and lists follow what they show."""

import json
import time
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from common import change, present
from studio_browser import (
    LOCAL,
    NEEDS_BROWSER,
    Visit,
    asked,
    choose,
    drawn,
    lines,
    named,
    settle,
    shown_steps,
    until,
    zoom_in,
)
from studio_runs import PENDULUM_TOM, set_status, trains_elsewhere

from tom.analysis.settings import USUAL
from tom.record.reader import RunReader

if TYPE_CHECKING:
    from playwright.sync_api import Locator, Page

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
    page.goto(visit.links.user_address(START))
    all_steps = shown_steps(drawn(page))
    page.get_by_role("button", name="Hide MLE", exact=True).click()
    settle(page, "hide=MLE")
    assert lines(page) == {"TOM"}
    zoomed = zoom_in(drawn(page))
    settle(page, "zoom=")
    same_steps(page, zoomed)
    page.get_by_role("button", name="Link", exact=False).first.click()
    page.locator("code", has_text="zoom=").wait_for()
    page.keyboard.press("Escape")
    page.wait_for_timeout(1500)
    page.locator(".runlist .head .name", has_text="TOM").click()
    page.locator(".runlist .run .eye").last.click()
    settle(page, "hide=pendulum-tom-1")
    counted(page, "TOM (1 seed, no band)")
    same_steps(page, zoomed)  # a redraw keeps it
    page.reload()
    counted(page, "TOM (1 seed, no band)")
    same_steps(page, zoomed)
    page.go_back()
    page.wait_for_url(lambda address: "pendulum-tom-1" not in address)
    counted(page, "TOM (n = 2)")
    same_steps(page, zoomed)
    page.get_by_role("button", name="Show all").click()
    until(page, lambda: lines(page) == {"MLE", "TOM"}, "MLE is not shown again")
    box = present(drawn(page).locator(".nsewdrag").first.bounding_box())
    page.mouse.dblclick(box["x"] + 0.5 * box["width"], box["y"] + 0.5 * box["height"])
    page.wait_for_url(lambda address: "zoom=" not in address)
    assert shown_steps(drawn(page)) == pytest.approx(all_steps)


def test_back_takes_back_a_step_and_a_run_and_no_correction(visit: Visit) -> None:
    page, links = visit.page, visit.links
    run = RunReader(Path(links.store) / PENDULUM_TOM)
    fits = run.profiles().env_step.tolist()
    first, second, *_ = sorted({*fits, *run.evaluation_steps()})

    def at(step: int) -> None:
        page.locator(".timeline output").get_by_text(f"step {step:,}", exact=True).wait_for()
        page.wait_for_timeout(1500)

    page.goto(links.user_address(START))
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


def test_hostile_words_are_plain_words_in_the_list_of_runs(visit_own: Visit, own: Path) -> None:
    visit, path = visit_own, own / PENDULUM_TOM / "config.json"
    change(path, learner=HOSTILE)
    page = visit.page
    page.goto(visit.links.user_address(START))
    title = page.locator(".runlist .head .name").get_by_text(HOSTILE)
    title.click()
    page.locator(".runlist .run .name").first.wait_for()
    assert page.locator(".runlist img").count() == 0
    assert visit.asked <= LOCAL


def seen_lines(chart: "Locator") -> int:
    """The lines and bands that can be seen, not those that Plotly was told to draw."""
    return chart.locator(".scatterlayer .trace").count()


def test_a_chart_follows_its_page_whatever_its_groups_are_called(
    visit_own: Visit,
    own: Path,
) -> None:
    visit, path = visit_own, own / PENDULUM_TOM / "config.json"
    change(path, preset="8.5, #a [b] > 'c' :d")
    page = visit.page
    page.goto(visit.links.user_address("curves?task=inverted-pendulum"))
    chart = drawn(page)
    assert seen_lines(chart) == 6  # each of the three is an edge and its inside
    group_by(page, "learner")
    until(page, lambda: "TOM (n = 2)" in named(page), "not grouped")
    until(page, lambda: seen_lines(chart) == 3, "not two lines and a band")
    group_by(page, USUAL)
    until(page, lambda: "TOM (n = 2)" not in named(page), "still grouped")
    until(page, lambda: seen_lines(chart) == 6, "old lines have stayed")


def group_by(page: "Page", what: str) -> None:
    if not page.get_by_role("combobox", name="Group by").first.is_visible():  # it may be open yet
        page.get_by_role("button", name="Filter and group").click()
    choose(page, "Group by", what)
    page.keyboard.press("Escape")


def test_an_open_page_takes_up_a_training_that_starts(visit_own: Visit, own: Path) -> None:
    page = visit_own.page
    page.goto(visit_own.links.user_address("?task=inverted-pendulum"))
    page.get_by_text("Does it help?").wait_for()
    trains_elsewhere(own / PENDULUM_TOM)
    stop = page.get_by_role("button", name="Stop", exact=False)
    stop.wait_for()
    ended = {"state": "finished", "heartbeat": time.time()}
    set_status(own / PENDULUM_TOM, **ended)
    stop.wait_for(state="detached")
    page.get_by_text("last return").first.wait_for()  # its card stays for a while


def test_a_curve_follows_its_run_and_keeps_what_the_reader_has_zoomed_to(
    visit_own: Visit,
    own: Path,
) -> None:
    page, run = visit_own.page, own / PENDULUM_TOM
    trains_elsewhere(run)
    page.goto(visit_own.links.user_address(f"curves?run={PENDULUM_TOM}&find={PENDULUM_TOM}"))
    curve = drawn(page)
    zoomed = zoom_in(curve)
    trains_elsewhere(run)
    record_another_return(run, 5000)
    end = "plot => plot.calcdata?.at(-1)?.at(-1).x"  # there is no data while Plotly draws anew
    until(page, lambda: curve.evaluate(end) == 5000, "the curve does not follow its run")
    assert shown_steps(curve) == pytest.approx(zoomed, rel=1e-4)


def record_another_return(run: Path, step: int) -> None:
    (run / "metrics.parquet").unlink()
    with (run / "metrics.jsonl").open("a") as file:
        file.write(json.dumps({"env_step": step, "eval/return": 1.0}) + "\n")


def test_enter_takes_one_run_and_not_every_match(visit: Visit) -> None:
    page = visit.page
    page.goto(visit.links.user_address("curves?part=Runs&task=inverted-pendulum"))
    field = page.get_by_role("combobox", name="Runs to label or to move to the trash")
    field.click()
    field.press_sequentially("TOM")
    page.get_by_role("option").first.wait_for()
    field.press("Enter")
    page.get_by_text("Move it to the trash").wait_for()
