"""Links from the pages' words to the glossary."""

import re

import pytest

from app import text as pages_text


def test_every_linked_word_has_an_entry_with_its_anchor() -> None:
    assert set(pages_text.LINKED.values()) <= set(pages_text.terms())
    places = re.findall(r'id="([^"]+)"', pages_text.glossary())
    assert len(set(places)) == len(places) == len(pages_text.terms())
    for word in pages_text.LINKED:
        (target,) = re.findall(
            r"\(glossary#(.+?)\)", pages_text.with_glossary_links(f"the {word} of a fit")
        )
        assert target in places


@pytest.mark.parametrize(
    ("text", "links"),
    [("A footprint is a Footprint", 1), ("exam/footprint", 0), ("[exam](x)", 0), ("examined", 0)],
)
def test_a_term_is_linked_where_it_stands_first(text: str, links: int) -> None:
    assert pages_text.with_glossary_links(text).count("glossary#") == links
