"""What a visitor sees is in the address: for another tab, a reload, and Back."""

import json
import shutil
from pathlib import Path
from typing import TYPE_CHECKING
from urllib.parse import parse_qs, urlsplit

import pytest
from studio_runs import PENDULUM_TOM
from test_browser import (  # noqa: F401 (own and visit are fixtures)
    LOCAL,
    Visit,
    own,
    shown_steps,
    visit,
    wait_until_steady,
    zoom_in,
)

from tom.record.reader import RunReader

if TYPE_CHECKING:
    from playwright.sync_api import Locator, Page

pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(shutil.which("chromium") is None, reason="needs Debian's chromium"),
]
START = "compare?env=inverted-pendulum"
HOSTILE = "<img src=http://evil.example/x.png onerror=alert(1)>"


def chart(page: "Page") -> "Locator":
    found = page.locator(".js-plotly-plot").first
    found.locator(".nsewdrag").first.wait_for()
    return found


def hidden(page: "Page") -> list[str]:
    """Entries of the figure's legend that are switched off."""
    lines = "plot => plot._fullData.filter(({showlegend: on}) => on).map(l => [l.name, l.visible])"
    return [name for name, visible in chart(page).evaluate(lines) if visible == "legendonly"]


def asked(page: "Page") -> dict[str, list[str]]:
    return parse_qs(urlsplit(page.url).query)


def settle(page: "Page", words: str) -> None:
    page.wait_for_url(lambda address: words in address)
    page.wait_for_timeout(1500)  # no drawing is under way, so that the next one is another entry


def same_steps(page: "Page", zoomed: list[float]) -> None:
    assert shown_steps(chart(page)) == pytest.approx(zoomed, rel=1e-4)


def test_what_is_hidden_and_zoomed_is_in_the_address_and_back_goes_back(visit: Visit) -> None:  # noqa: F811
    page = visit.page
    page.goto(visit.links.opened(START))
    all_steps = shown_steps(chart(page))
    page.locator(".js-plotly-plot .legendtoggle").first.click()
    settle(page, "hide=MLE")
    assert hidden(page) == ["MLE (1 seed, no band)"]
    assert page.get_by_role("button", name="Show MLE").is_visible()
    zoomed = zoom_in(chart(page))
    settle(page, "zoom=")
    assert asked(page)["zoom"][0].startswith("inverted-pendulum~")
    page.get_by_role("button", name="TOM", exact=True).click()
    page.get_by_role("button", name="Hide TOM s1").click()
    settle(page, "hide=pendulum-tom-1")
    page.locator(".js-plotly-plot").get_by_text("TOM (1 seed, no band)").wait_for()
    same_steps(page, zoomed)  # a redraw keeps it
    shared = page.url

    browser = page.context.browser
    assert browser is not None
    second = browser.new_page(viewport={"width": 1280, "height": 1000})  # somebody else's
    second.goto(visit.links.opened(shared.removeprefix(f"{visit.links.address}/")))
    second.locator(".js-plotly-plot").get_by_text("TOM (1 seed, no band)").wait_for()
    assert hidden(second) == ["MLE (1 seed, no band)"]
    same_steps(second, zoomed)
    second.wait_for_url(shared)
    second.get_by_role("button", name="Show all").click()
    second.wait_for_url(lambda address: "hide=" not in address)
    second.locator(".js-plotly-plot").get_by_text("TOM (n = 2)").wait_for()
    assert hidden(second) == []
    box = chart(second).locator(".nsewdrag").first.bounding_box()
    assert box is not None
    second.mouse.dblclick(box["x"] + 0.5 * box["width"], box["y"] + 0.5 * box["height"])
    second.wait_for_url(lambda address: "zoom=" not in address)
    assert shown_steps(chart(second)) == pytest.approx(all_steps)
    second.close()

    page.reload()
    page.locator(".js-plotly-plot").get_by_text("TOM (1 seed, no band)").wait_for()
    same_steps(page, zoomed)
    page.go_back()
    page.wait_for_url(lambda address: "pendulum-tom-1" not in address)
    page.locator(".js-plotly-plot").get_by_text("TOM (n = 2)").wait_for()
    same_steps(page, zoomed)
    page.go_back()
    page.wait_for_url(lambda address: "zoom=" not in address)
    page.wait_for_timeout(1500)
    assert shown_steps(chart(page)) == pytest.approx(all_steps)
    assert hidden(page) == ["MLE (1 seed, no band)"]
    page.go_forward()
    page.wait_for_url(lambda address: "zoom=" in address)
    page.wait_for_timeout(1500)
    same_steps(page, zoomed)


@pytest.mark.quick
def test_back_takes_back_one_choice_after_the_other(visit: Visit) -> None:  # noqa: F811
    page = visit.page
    page.goto(visit.links.opened(START))
    chart(page)
    page.get_by_role("radio", name="Statistics").click()
    settle(page, "show=Statistics")
    page.get_by_role("radio", name="Curves").click()
    page.wait_for_url(lambda address: "show=" not in address)
    chart(page)
    page.get_by_role("button", name="Measure").click()
    page.get_by_text("log y").click()
    settle(page, "logy=true")
    page.go_back()
    page.wait_for_url(lambda address: "logy" not in address)
    chart(page)
    assert asked(page) == {"env": ["inverted-pendulum"]}
    page.go_back()
    page.get_by_text("Performance profile").wait_for()
    assert page.get_by_role("radio", name="Statistics").is_checked()
    page.go_back()
    page.get_by_text("1000 resamples").wait_for()
    assert page.get_by_role("radio", name="Curves").is_checked()
    visit.open("Weights", "weights")
    shown, busy = page.get_by_text("Every fit"), page.get_by_test_id("stStatusWidget")
    # At rest: a picture asked for after its page was left is gone, which the console would tell.
    wait_until_steady(page, lambda: shown.count() > 0 and not busy.count(), 1)
    page.go_back()
    page.get_by_text("1000 resamples").wait_for()
    assert asked(page) == {"env": ["inverted-pendulum"]}
    assert page.locator(".js-plotly-plot").count() == 1


def test_back_takes_back_a_step_and_a_run_and_no_correction(visit: Visit) -> None:  # noqa: F811
    page, links = visit.page, visit.links
    first, second, *_ = RunReader(Path(links.store) / PENDULUM_TOM).profiles().env_step.tolist()
    page.goto(links.opened("compare?env=inverted-pendulum"))
    chart(page)
    entries = page.evaluate("history.length")
    page.goto(f"{links.address}/weights?run={PENDULUM_TOM}&step={first + 1}")
    words = f"Step {first + 1:,} was not kept; this is the nearest, {first:,}."
    page.get_by_text(words).wait_for()
    settle(page, f"step={first}")
    page.get_by_test_id("stSlider").get_by_role("slider").press("ArrowRight")
    settle(page, f"step={second}")
    page.get_by_text(f"The fit at step {second:,}").wait_for()
    page.get_by_label("Run", exact=True).click()
    page.get_by_role("option", name="Road and rocks").first.click()
    page.wait_for_url(lambda address: PENDULUM_TOM not in address)
    page.wait_for_timeout(1500)
    elsewhere = asked(page)
    assert elsewhere["step"] != [str(second)]
    visit.open("Regions", "regions")
    page.wait_for_url(lambda address: "run=" in address)
    page.wait_for_timeout(1500)
    assert page.evaluate("history.length") == entries + 4
    page.go_back()
    page.wait_for_url(lambda address: asked(page) == elsewhere)
    page.wait_for_timeout(1500)
    page.go_back()
    page.get_by_text(f"The fit at step {second:,}").wait_for()
    assert asked(page) == {"run": [PENDULUM_TOM], "step": [str(second)]}
    page.wait_for_timeout(1500)
    page.go_back()
    page.get_by_text(f"The fit at step {first:,}").wait_for()
    assert asked(page)["step"] == [str(first)]
    assert page.get_by_text("was not kept").count() == 0
    page.wait_for_timeout(1500)
    page.go_forward()
    page.get_by_text(f"The fit at step {second:,}").wait_for()
    page.wait_for_timeout(1500)
    page.reload()
    page.get_by_text(f"The fit at step {second:,}").wait_for()
    page.go_back()
    page.wait_for_timeout(1500)
    page.go_back()
    chart(page)
    assert asked(page) == {"env": ["inverted-pendulum"]}


def test_hostile_words_are_plain_words_in_the_list_of_runs(visit: Visit, own: Path) -> None:  # noqa: F811
    path = own / PENDULUM_TOM / "config.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"learner": HOSTILE}))
    page = visit.page
    page.goto(visit.links.opened(START))
    title = page.locator(".eyes .head .name").get_by_text(HOSTILE)
    title.click()
    page.locator(".eyes .run .name").first.wait_for()
    assert page.locator(".eyes img").count() == 0
    assert visit.asked <= LOCAL
