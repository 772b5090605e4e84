"""Words from files do no harm."""

import re
from collections.abc import Callable

import pytest

from app import text
from tom import harmless

GITHUB_ADDRESS = re.compile(
    r"(https?://|www(?=\.))[-.\w]+|[-.\w+]+@[-\w]+(\.[-\w]+)+", re.IGNORECASE
)


@pytest.mark.parametrize(
    "hostile",
    ["![x](http://evil/x.png)", "<script>alert(1)</script>", ":material/delete:", "$x$", "**b**"],
)
def test_markdown_shows_what_it_is_given(hostile: str) -> None:
    shown = text.markdown(hostile)
    unescaped = shown.replace("\\", "").replace("\u2060", "")
    assert unescaped == hostile
    for i, character in enumerate(shown):
        if character in "[]()<>*!:$_":
            assert shown[i - 1] == "\\"


@pytest.mark.parametrize("escaped", [text.markdown, harmless.markdown])
@pytest.mark.parametrize(
    "address",
    ["https://evil.example/x", "a HTTP://evil.example", "www.evil.example", "(me@evil.example)"],
)
def test_an_address_is_no_link(escaped: Callable[[object], str], address: str) -> None:
    literal = escaped(address).replace("\\", "")  # where GitHub's Markdown looks for addresses
    assert GITHUB_ADDRESS.search(address)
    assert not GITHUB_ADDRESS.search(literal)
    assert literal.replace("\u2060", "") == address


def test_plotly_has_no_tags() -> None:
    assert text.plotly('<a href="x">y</a>\nz') == "&lt;a href=&quot;x&quot;&gt;y&lt;/a&gt; z"


@pytest.mark.parametrize(
    ("words", "value"),
    [("12", 12), (7, 7), ("", None), ("-1", None), ("\u00b2", None), ("9" * 5000, None)],
)
def test_a_whole_number(words: object, value: int | None) -> None:
    assert text.parse_int(words) == value
