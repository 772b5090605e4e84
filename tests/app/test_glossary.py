"""Links from the pages' words to the glossary."""

import re
from pathlib import Path

import pytest

from app import glossary


def test_every_linked_word_has_an_entry_with_its_anchor() -> None:
    assert set(glossary.WORDS.values()) <= set(glossary.terms())
    places = re.findall(r'id="([^"]+)"', glossary.page())
    assert len(set(places)) == len(places) == len(glossary.terms())
    for word in glossary.WORDS:
        (target,) = re.findall(r"\(glossary#(.+?)\)", glossary.linked(f"the {word} of a fit"))
        assert target in places


@pytest.mark.parametrize(
    ("text", "links"),
    [("A footprint is a Footprint", 1), ("exam/footprint", 0), ("[exam](x)", 0), ("examined", 0)],
)
def test_a_term_is_linked_where_it_stands_first(text: str, links: int) -> None:
    assert glossary.linked(text).count("glossary#") == links


def test_without_the_file_there_is_no_link(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(glossary, "FILE", Path("nowhere"))
    assert glossary.linked("footprint") == "footprint"
    assert glossary.terms() == {}
