"""Charts in a real browser: drawn whatever runs are called, saved, or said to have failed."""

import json
from pathlib import Path
from typing import TYPE_CHECKING

from studio_browser import NEEDS_BROWSER, Visit, choose, drawn, named, until
from studio_runs import PENDULUM_TOM

from tom.analysis.settings import USUAL

if TYPE_CHECKING:
    from playwright.sync_api import Locator, Page

pytestmark = NEEDS_BROWSER
HOSTILE = "8.5, #a [b] > 'c' :d"
REACT = "window.Plotly.react"
BEGINS = {"SVG": b"<", "PDF": b"%PDF", "PNG": b"\x89PNG", "CSV": b"line,"}
"""the files of a figure, and how each begins"""


def lines(chart: "Locator") -> int:
    """The lines and bands that can be seen, not those that Plotly was told to draw."""
    return chart.locator(".scatterlayer .trace").count()


def test_a_chart_follows_its_page_and_is_saved_whatever_its_groups_are_called(
    visit: Visit,
    own: Path,
) -> None:
    path = own / PENDULUM_TOM / "config.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"preset": HOSTILE}))
    page = visit.page
    page.goto(visit.links.opened("curves?task=inverted-pendulum"))
    chart = drawn(page)
    assert lines(chart) == 4  # one of the three is hollow: an edge and its inside
    group_by(page, "learner")
    until(page, lambda: "TOM (n = 2)" in named(page), "not grouped")
    until(page, lambda: lines(chart) == 3, "not two lines and a band")
    group_by(page, USUAL)
    until(page, lambda: "TOM (n = 2)" not in named(page), "still grouped")
    until(page, lambda: lines(chart) == 4, "old lines have stayed")
    chart.hover()
    chart.locator(".modebar-btn[data-title^='Save']").click()
    for width in ("as shown", "one column"):
        page.locator("dialog[open]").get_by_text(width).click()
        for kind, begins in BEGINS.items():
            with page.expect_download() as saved:
                page.locator("dialog[open]").get_by_role("button", name=kind, exact=True).click()
            assert saved.value.suggested_filename.endswith(f".{kind.lower()}")
            assert saved.value.path().read_bytes().startswith(begins)


def group_by(page: "Page", what: str) -> None:
    if not page.get_by_role("combobox", name="Group by").first.is_visible():  # it may be open yet
        page.get_by_role("button", name="Filter and group").click()
    choose(page, "Group by", what)
    page.keyboard.press("Escape")


def test_a_chart_that_cannot_be_drawn_says_so_until_it_can(visit: Visit) -> None:
    page = visit.page
    page.goto(visit.links.opened("curves?task=inverted-pendulum"))
    chart = drawn(page)
    page.evaluate(f"""() => {{
        window.whole = {REACT};
        {REACT} = () => Promise.reject(new Error("no such shape"));
        console.error = () => {{}};  // every other error in a console fails the tests
    }}""")
    group_by(page, "learner")
    page.get_by_role("alert").get_by_text("no such shape").first.wait_for()
    assert lines(chart) == 0
    page.evaluate(f"() => {{ {REACT} = window.whole; }}")
    group_by(page, USUAL)
    drawn(page)
    page.get_by_role("alert").first.wait_for(state="hidden")
