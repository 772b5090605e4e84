"""A list of groups and their runs, each with an eye that shows or hides it."""

from collections.abc import Callable, Sequence
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import streamlit as st
from streamlit.components.v2 import component

from app.figures.curves import Look

_SCRIPT = Path(__file__).with_name("eyes.js")
_STYLE = Path(__file__).with_name("eyes.css")


class Item(NamedTuple):
    """A run."""

    run_id: str
    name: str
    hidden: bool


class Row(NamedTuple):
    """A group and its runs."""

    look: Look
    hidden: bool
    runs: Sequence[Item]


def eyes(
    rows: Sequence[Row], key: str, toggled: Callable[[str], None], everything: Callable[[], None]
) -> None:
    """Show the list.

    `toggled` is called with the title of a group or the id of a run, `everything` when the user
    asks to show all. Both run before the page is drawn again.
    """

    def on(event: str, act: Callable[..., None]) -> None:
        values = st.session_state[key].get(event)
        if values is not None:
            act(*values)

    groups: list[dict[str, Any]] = [
        {
            "title": row.look.title,
            "colour": row.look.colour,
            "dash": row.look.dash,
            "hidden": row.hidden,
            "runs": [item._asdict() for item in row.runs],
        }
        for row in rows
    ]
    _mount()(
        key=key,
        data={"groups": groups},
        on_toggled_change=partial(on, "toggled", toggled),
        on_everything_change=partial(on, "everything", everything),
    )


@cache
def _mount():
    return component(
        "tom_eyes",
        html='<div class="eyes" role="group" aria-label="Runs in the figure"></div>',
        css=_STYLE.read_text(),
        js=_SCRIPT.read_text(),
        isolate_styles=False,
    )
