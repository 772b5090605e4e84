"""What the studio knows of a browser's tab."""

from types import SimpleNamespace

import pytest
import streamlit as st
from studio_pages import set_links

from app import session
from app.links import Links
from app.theme import Mode


@pytest.mark.parametrize(
    ("given", "browser", "first", "then"),
    [
        ("dark", "light", "dark", "light"),  # then its user's own choice counts
        (None, "dark", "dark", "dark"),
        ("dark", None, "dark", "dark"),
        (None, None, "light", "light"),
    ],
)
def test_a_tab_s_first_page_is_in_the_studio_s_theme(
    given: Mode | None, browser: str | None, first: str, then: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    set_links(Links(theme=given), monkeypatch)
    monkeypatch.setattr(st, "context", SimpleNamespace(theme=SimpleNamespace(type=browser)))
    monkeypatch.setattr(st, "session_state", {})
    assert session.mode() == first
    session.drawn()
    assert session.mode() == then
