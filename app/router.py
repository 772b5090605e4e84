"""The list of pages. A new page is one module of `app.views` with `page()`, named here."""

import gc
import html
import sys
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from importlib import import_module
from threading import Event, Thread
from types import ModuleType

import streamlit as st
from streamlit.errors import StreamlitAPIException
from streamlit.navigation.page import StreamlitPage

from app import session
from app.data import readers
from app.parts import address
from app.theme import LEARNER_COLOURS, NEUTRAL
from tom.learners import SUBJECT
from tom.plugins.kept import PAGES, Page


@dataclass(frozen=True)
class View:
    """A page of ours. Its module, `app.views.<name>`, is imported when it is drawn first."""

    name: str
    TITLE: str
    ICON: str
    PATH: str

    def load(self) -> ModuleType:
        """Its module, imported by the first caller; others wait for it."""
        module = f"app.views.{self.name}"
        first = module not in sys.modules
        loaded = import_module(module)
        if first:
            # The libraries' 400 000 objects last as long as the process: to look through them would
            # take 0.3 s of each collection of garbage.
            gc.freeze()
        return loaded

    def page(self) -> None:
        """Draw it, for the runs of the list at the left."""
        from app.parts import scope  # here: it imports the simulator

        view = self.load()
        shown = scope.draw()
        view.page(shown)
        _read_ahead(shown.chosen_id)


AHEAD = "read ahead"
"""the run whose buffer this session has read ahead"""
FIRST = Event()
"""a page has been drawn to its end"""
PLAIN_ICON = ":material/extension:"

VIEWS = (
    View("answer", "Answer", ":material/lightbulb:", ""),
    View("curves", "Curves", ":material/stacked_line_chart:", "curves"),
    View("attention", "Attention", ":material/gradient:", "attention"),
    View("replays", "Replays", ":material/replay:", "replays"),
    View("findings", "Findings", ":material/lab_profile:", "findings"),
)
BARS = ((5, NEUTRAL), (8, NEUTRAL), (6, NEUTRAL), (20, LEARNER_COLOURS[SUBJECT]))
"""the studio's logo: heights and colours of a weight profile"""


def logo_svg(width: int, name: str = "") -> str:
    """The weight profile as SVG. Streamlit would load a named icon from the internet."""
    bars = "".join(
        f'<rect x="{2 + 6 * i}" y="{22 - h}" width="4.4" height="{h}" rx="1" fill="{colour}"/>'
        for i, (h, colour) in enumerate(BARS)
    )
    box = f'width="{width}" height="24" viewBox="0 0 {width} 24"'
    return f'<svg xmlns="http://www.w3.org/2000/svg" {box}>{bars}{name}</svg>'


ICON = logo_svg(27)
LOGO = logo_svg(
    132,
    '<text x="32" y="18" font-family="Source Sans, sans-serif" font-size="17" '
    # The same width in any font, because the named font may be missing.
    'font-weight="700" textLength="97" lengthAdjust="spacingAndGlyphs" '
    f'fill="{LEARNER_COLOURS[SUBJECT]}">TOM Studio</text>',
)


def _read_ahead(run_id: str) -> None:
    """Read the buffer of a newly chosen run in the background, before Attention needs it."""
    if not run_id or run_id == st.session_state.get(AHEAD):
        return
    st.session_state[AHEAD] = run_id
    found = (run for run in readers.listing(session.links().store).runs if run.run_id == run_id)
    run = next(found, None)
    if run is None or run.status.alive:
        return

    def read() -> None:
        from app.data import buffer_map  # here: it imports torch

        with suppress(Exception):  # the page meets the same error, and shows it
            buffer_map.read_ahead(run)

    Thread(target=read, daemon=True).start()


def views() -> tuple[View | Page, ...]:
    """Our pages, then those of plug-ins."""
    return (*VIEWS, *PAGES)


def run() -> None:
    """Draw the page in the address, or that of an empty store."""
    st.set_page_config(page_title="TOM Studio", page_icon=ICON, layout="wide")
    st.logo(LOGO, size="medium")
    pages = [_streamlit_page(view, view.ICON, first=i == 0) for i, view in enumerate(views())]
    chosen = st.navigation(pages, position="top")
    st.session_state["pages"] = {page.url_path: page for page in pages}
    address.enter_page(chosen.url_path)
    st.html(f'<h1 class="heard">{html.escape(chosen.title)}</h1>')  # the menu says it to the eye
    draw(chosen.run)
    task = st.session_state.get("task shown", "")
    st.set_page_config(page_title=" - ".join(filter(None, (chosen.title, task, "TOM Studio"))))
    st.session_state[session.DRAWN] = True
    FIRST.set()


def _streamlit_page(view: View | Page, icon: str, first: bool) -> StreamlitPage:
    """The page as Streamlit lists it. A plug-in's icon that is none must not stop the others."""
    try:
        return st.Page(view.page, title=view.TITLE, icon=icon, url_path=view.PATH, default=first)
    except StreamlitAPIException:
        if icon == PLAIN_ICON:
            raise
        return _streamlit_page(view, PLAIN_ICON, first)


def draw(page: Callable[[], None]) -> None:
    """The page, or that of an empty store: neither runs, also in the trash, nor weighed data."""
    store = session.links().store
    if not (readers.listing(store).runs or readers.trashed(store)):
        from app.data import weighings  # here: a store with runs needs neither
        from app.parts import start

        if not weighings.datasets(store):
            page = start.draw_first_page
    page()
