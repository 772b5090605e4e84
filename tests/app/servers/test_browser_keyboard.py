"""A visitor without a mouse: nothing done takes the focus away."""

import shutil
from typing import TYPE_CHECKING

import pytest
from test_browser import Visit, own, visit  # noqa: F401 (fixtures)
from test_browser_visitor import until

if TYPE_CHECKING:
    from playwright.sync_api import Page

pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(shutil.which("chromium") is None, reason="needs Debian's chromium"),
]
FOCUSED = """() => {
  const here = document.activeElement;
  const name = here.ariaLabel || here.title || here.innerText || here.getAttribute("placeholder");
  return name ? name.trim() : "";
}"""
STOPS = 120
"""presses of Tab after which a control counts as out of reach"""


def tab_to(page: "Page", wanted: str) -> None:
    """Press Tab until the focus is on the control whose name ends with `wanted`."""
    for _ in range(STOPS):
        page.keyboard.press("Tab")
        if page.evaluate(FOCUSED).endswith(wanted):
            return
    pytest.fail(f"Tab never reaches {wanted}")


def open_at(visit: Visit, path: str) -> "Page":  # noqa: F811
    page = visit.page
    page.goto(visit.links.opened(path))
    page.locator(".runlist .section").first.wait_for()
    page.wait_for_load_state("networkidle")
    return page


def test_an_eye_keeps_the_focus_when_the_page_is_drawn_again(visit: Visit) -> None:  # noqa: F811
    page = open_at(visit, "curves")
    eye = page.locator(".runlist .head button").first
    name = (eye.get_attribute("aria-label") or "").removeprefix("Hide ")
    tab_to(page, f"Hide {name}")
    page.keyboard.press("Enter")
    until(page, lambda: page.evaluate(FOCUSED) == f"Show {name}", "the eye has lost the focus")
    page.wait_for_load_state("networkidle")
    page.keyboard.press("Space")
    until(page, lambda: page.evaluate(FOCUSED) == f"Hide {name}", "the eye has lost the focus")


def test_a_menu_opens_by_enter_and_escape_gives_the_focus_back(visit: Visit) -> None:  # noqa: F811
    page = open_at(visit, "curves")
    link = page.get_by_test_id("stPopover").get_by_role("button", name="Link").first
    link.wait_for()
    link.focus()
    page.keyboard.press("Enter")
    page.get_by_text("This address shows what you see now").wait_for()
    page.keyboard.press("Escape")
    until(page, lambda: "Link" in page.evaluate(FOCUSED), "the menu has lost the focus")
    page.get_by_text("This address shows what you see now").wait_for(state="hidden")


def test_a_search_by_slash_and_help_by_question_mark(visit: Visit) -> None:  # noqa: F811
    page = open_at(visit, "curves")
    page.keyboard.press("/")
    assert page.evaluate("document.activeElement.matches('[data-testid=stSidebar] input')")
    page.keyboard.press("Escape")
    page.evaluate("document.activeElement.blur()")
    page.keyboard.press("?")
    page.get_by_role("dialog", name="Shortcuts").wait_for()
    page.keyboard.press("Escape")
    page.get_by_role("dialog", name="Shortcuts").wait_for(state="hidden")
