"""Which page is shown. A new page is one module with TITLE, ICON, PATH and page(), named here."""

from collections.abc import Callable

import numpy as np
import streamlit as st
from PIL import Image

from app import session
from app.data import readers
from app.parts import empty
from app.scenes.colours import rgb
from app.theme import LEARNER_COLOURS, NEUTRAL
from app.views import compare, live, probe, regions, replays, road, studies, weights

VIEWS = (live, compare, weights, regions, probe, replays, road, studies)
BARS = ((5, NEUTRAL), (8, NEUTRAL), (6, NEUTRAL), (20, LEARNER_COLOURS["tom"]))
"""the sign of the studio: heights and colours of a weight profile"""
LOGO = (
    '<svg xmlns="http://www.w3.org/2000/svg" width="132" height="24" viewBox="0 0 132 24">'
    + "".join(
        f'<rect x="{2 + 6 * i}" y="{22 - h}" width="4.4" height="{h}" rx="1" fill="{colour}"/>'
        for i, (h, colour) in enumerate(BARS)
    )
    + '<text x="32" y="18" font-family="Source Sans, sans-serif" font-size="17" '
    # As wide in any font: the one that is named is not on every machine.
    'font-weight="700" textLength="97" lengthAdjust="spacingAndGlyphs" '
    f'fill="{LEARNER_COLOURS["tom"]}">TOM Studio</text></svg>'
)


def icon() -> Image.Image:
    """The tab's icon: drawn here, as Streamlit fetches named icons from outside."""
    image = np.zeros((48, 48, 4), np.uint8)
    for i, (height, colour) in enumerate(BARS):
        image[46 - 2 * height : 46, 1 + 12 * i : 10 + 12 * i] = (*rgb(colour), 255)
    return Image.fromarray(image)


def run() -> None:
    """Draw the page that the address names; the empty store's page while there is no run."""
    st.set_page_config(page_title="TOM Studio", page_icon=icon(), layout="wide")
    st.logo(LOGO, size="medium")
    pages = [
        st.Page(view.page, title=view.TITLE, icon=view.ICON, url_path=view.PATH, default=i == 0)
        for i, view in enumerate(VIEWS)
    ]
    chosen = st.navigation(pages, position="top")
    draw(chosen.run)


def draw(page: Callable[[], None]) -> None:
    """The page, or the empty store's while there is no run."""
    if readers.listing(session.links().store).runs:
        page()
    else:
        empty.page()
