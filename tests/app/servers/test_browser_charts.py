"""Charts in a real browser: drawn whatever runs are called, saved, or said to have failed."""

import json
import shutil
from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from studio_runs import PENDULUM_TOM
from test_browser import Visit, own, visit  # noqa: F401 (two are fixtures)
from test_browser_visitor import choose, until

if TYPE_CHECKING:
    from playwright.sync_api import Locator, Page

pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(shutil.which("chromium") is None, reason="needs Debian's chromium"),
]
HOSTILE = "8.5, #a [b] > 'c' :d"
REACT = "window.Plotly.react"


def drawn(page: "Page") -> "Locator":
    chart = page.locator(".js-plotly-plot").first
    chart.locator(".nsewdrag").first.wait_for()
    return chart


def lines(chart: "Locator") -> int:
    """The lines and bands that can be seen, not those that Plotly was told to draw."""
    return chart.locator(".scatterlayer .trace").count()


def test_a_chart_follows_its_page_and_is_saved_whatever_its_groups_are_called(
    visit: Visit,  # noqa: F811
    own: Path,  # noqa: F811
) -> None:
    path = own / PENDULUM_TOM / "config.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {"preset": HOSTILE}))
    page = visit.page
    page.goto(visit.links.opened("compare?env=inverted-pendulum&singles=false"))
    chart = drawn(page)
    assert lines(chart) == 3
    choose(page, "Group by", "by learner")
    chart.get_by_text("TOM (n = 2)").wait_for()
    until(page, lambda: lines(chart) == 3, "not two lines and a band")
    choose(page, "Group by", "by all but the seed")
    chart.get_by_text("TOM (n = 2)").wait_for(state="detached")
    until(page, lambda: lines(chart) == 3, "old lines have stayed")
    for format in ("png", "svg"):
        chart.hover()
        with page.expect_download() as saved:
            chart.locator(f".modebar-btn[data-title='save as {format.upper()}']").click()
        assert saved.value.suggested_filename.endswith(format)


def test_a_chart_that_cannot_be_drawn_says_so_until_it_can(visit: Visit) -> None:  # noqa: F811
    page = visit.page
    page.goto(visit.links.opened("compare?env=inverted-pendulum"))
    chart = drawn(page)
    page.evaluate(f"""() => {{
        window.whole = {REACT};
        {REACT} = () => Promise.reject(new Error("no such shape"));
        console.error = () => {{}};  // every other error in a console fails the tests
    }}""")
    choose(page, "Group by", "by learner")
    page.get_by_role("alert").get_by_text("no such shape").wait_for()
    assert lines(chart) == 0
    page.evaluate(f"() => {{ {REACT} = window.whole; }}")
    choose(page, "Group by", "by all but the seed")
    drawn(page)
    page.get_by_role("alert").wait_for(state="hidden")
