"""The list of runs: groups and their runs, each with an eye that shows or hides it."""

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import cache
from pathlib import Path

import streamlit as st
from streamlit.components.v2 import component

_SCRIPT = Path(__file__).with_name("runlist.js")
_STYLE = Path(__file__).with_name("runlist.css")


@dataclass(frozen=True)
class Item:
    """A run; `returns` are few values of its return, for a small line."""

    run_id: str
    name: str
    state: str
    returns: Sequence[float]
    hidden: bool
    chosen: bool


@dataclass(frozen=True)
class Group:
    """A group and its runs; a `folded` one stands below the others, behind a line."""

    title: str
    colour: str
    hidden: bool
    folded: bool
    runs: Sequence[Item]


@dataclass(frozen=True)
class Section:
    """A part of the list, such as the user's own runs; `more` is a remark below it."""

    title: str
    groups: Sequence[Group]
    more: str = ""


def draw(
    sections: Sequence[Section],
    *,
    toggled: Callable[[str], None],
    alone: Callable[[str], None],
    chosen: Callable[[str], None],
    everything: Callable[[], None],
) -> None:
    """Show the list.

    `toggled` and `alone` are called with the title of a group or the id of a run, `chosen` with the
    id of a run, `everything` when the user asks to show all: before the page is drawn again.
    """

    def on(event: str, act: Callable[..., None]) -> None:
        values = st.session_state["runlist"].get(event)
        if values is not None:
            act(*values)

    _mount()(
        key="runlist",
        data={"sections": [asdict(section) for section in sections]},
        on_toggled_change=lambda: on("toggled", toggled),
        on_alone_change=lambda: on("alone", alone),
        on_chosen_change=lambda: on("chosen", chosen),
        on_everything_change=lambda: on("everything", everything),
    )


@cache
def _mount():
    return component(
        "tom_runlist",
        html='<div class="runlist" role="group" aria-label="Runs"></div>',
        css=_STYLE.read_text(),
        js=_SCRIPT.read_text(),
        isolate_styles=False,
    )
