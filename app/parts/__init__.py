"""Parts of a page that run in the browser: each a package here, with its script and its style."""

from functools import cache
from pathlib import Path

from streamlit.components.v2 import component
from streamlit.components.v2.types import ComponentRenderer


@cache
def renderer(name: str, html: str) -> ComponentRenderer:
    """What draws the part `app.parts.<name>` in the page's own document: `<name>.js` and `.css`."""
    folder = Path(__file__).parent / name
    return component(
        f"tom_{name}",
        html=html,
        css=(folder / f"{name}.css").read_text(),
        js=(folder / f"{name}.js").read_text(),
        isolate_styles=False,
    )
