"""The pictures of pages."""

from app.router import VIEWS
from app.servers import browser
from app.views.attention import LEARNERS_ON_IT


def test_every_page_and_every_part_of_attention_has_a_picture() -> None:
    shown = [(path, choices.get("part", "")) for path, choices in browser.PAGES.values()]
    assert {path for path, _ in shown} == {view.PATH for view in VIEWS}
    assert {part for path, part in shown if path == "attention"} == {"", LEARNERS_ON_IT}
