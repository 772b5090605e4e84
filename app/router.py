"""The list of pages. A new page is one module with TITLE, ICON, PATH and page(), named here."""

from collections.abc import Callable
from types import ModuleType
from typing import Protocol

import numpy as np
import streamlit as st
from PIL import Image
from streamlit.errors import StreamlitAPIException
from streamlit.navigation.page import StreamlitPage

from app import session
from app.data import datasets, readers
from app.parts import address, empty
from app.scenes.colours import rgb
from app.theme import LEARNER_COLOURS, NEUTRAL
from app.views import cinema, compare, live, probe, regions, replays, road, studies, weights
from tom.learners import SUBJECT
from tom.plugins import PAGES


class Page(Protocol):
    """A page: a module, or a plug-in's object with the same attributes."""

    @property
    def TITLE(self) -> str: ...  # noqa: N802
    @property
    def ICON(self) -> str: ...  # noqa: N802
    @property
    def PATH(self) -> str: ...  # noqa: N802
    @property
    def page(self) -> Callable[[], None]: ...


PLAIN_ICON = ":material/extension:"

VIEWS: tuple[ModuleType, ...] = (
    live,
    compare,
    weights,
    regions,
    probe,
    replays,
    cinema,
    road,
    studies,
)
BARS = ((5, NEUTRAL), (8, NEUTRAL), (6, NEUTRAL), (20, LEARNER_COLOURS[SUBJECT]))
"""the studio's logo: heights and colours of a weight profile"""
LOGO = (
    '<svg xmlns="http://www.w3.org/2000/svg" width="132" height="24" viewBox="0 0 132 24">'
    + "".join(
        f'<rect x="{2 + 6 * i}" y="{22 - h}" width="4.4" height="{h}" rx="1" fill="{colour}"/>'
        for i, (h, colour) in enumerate(BARS)
    )
    + '<text x="32" y="18" font-family="Source Sans, sans-serif" font-size="17" '
    # The same width in any font, because the named font may be missing.
    'font-weight="700" textLength="97" lengthAdjust="spacingAndGlyphs" '
    f'fill="{LEARNER_COLOURS[SUBJECT]}">TOM Studio</text></svg>'
)


def views() -> tuple[Page | ModuleType, ...]:
    """Our pages, then those of plug-ins."""
    return (*VIEWS, *PAGES)


def icon() -> Image.Image:
    """The tab's icon, drawn here because Streamlit loads named icons from the internet."""
    image = np.zeros((48, 48, 4), np.uint8)
    for i, (height, colour) in enumerate(BARS):
        image[46 - 2 * height : 46, 1 + 12 * i : 10 + 12 * i] = (*rgb(colour), 255)
    return Image.fromarray(image)


def run() -> None:
    """Draw the page in the address, or the empty store's page if there are no runs."""
    st.set_page_config(page_title="TOM Studio", page_icon=icon(), layout="wide")
    st.logo(LOGO, size="medium")
    pages = [_listed(view, view.ICON, first=i == 0) for i, view in enumerate(views())]
    chosen = st.navigation(pages, position="top")
    address.visit(chosen.url_path)
    draw(chosen.run)
    address.write()
    session.drawn()


def _listed(view: Page | ModuleType, icon: str, first: bool) -> StreamlitPage:
    """The page as Streamlit lists it. A plug-in's icon that is none must not stop the others."""
    try:
        return st.Page(view.page, title=view.TITLE, icon=icon, url_path=view.PATH, default=first)
    except StreamlitAPIException:
        if icon == PLAIN_ICON:
            raise
        return _listed(view, PLAIN_ICON, first)


def draw(page: Callable[[], None]) -> None:
    """The page, or the empty store's page if there are neither runs nor weighed data."""
    store = session.links().store
    if readers.listing(store).runs or datasets.listing(store):
        page()
    else:
        empty.page()
