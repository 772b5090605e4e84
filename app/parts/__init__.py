"""Parts of a page that run in the browser: each a package here, with its script and its style."""

from collections.abc import Callable, Mapping, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any

import streamlit as st
from streamlit.components.v2 import component
from streamlit.components.v2.types import ComponentRenderer


def draw(
    name: str,
    html: str,
    key: str,
    data: Mapping[str, Any],
    height: Any = "content",
    scripts: Sequence[str] | None = None,
    **events: Callable[[Any], object],
) -> None:
    """Draw the part `app.parts.<name>` in the page's own document: `<name>.css`, and `<name>.js` or
    the `scripts`.

    Each of `events` is called with what the script tells of it, before the page is drawn again.
    """

    def on_event(event: str) -> None:
        value = st.session_state[key].get(event)
        if value is not None:
            events[event](value)

    callbacks: dict[str, Any] = {f"on_{event}_change": partial(on_event, event) for event in events}
    shown = _renderer(name, html, tuple(scripts or [name]))
    shown(key=key, data=data, height=height, **callbacks)


@cache
def _renderer(name: str, html: str, scripts: tuple[str, ...]) -> ComponentRenderer:
    folder = Path(__file__).parent / name
    return component(
        f"tom_{name}",
        html=html,
        css=(folder / f"{name}.css").read_text(),
        js="\n".join((folder / f"{script}.js").read_text() for script in scripts),
        isolate_styles=False,
    )
