"""The list of runs: groups and their runs, each with an eye that shows or hides it."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import streamlit as st

from app.parts.component import renderer

_HTML = '<div class="runlist" role="group" aria-label="Runs"></div>'


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
    """A group and its runs; `core` is the paler colour inside a hollow swatch.

    A `folded` one stands below the others, behind a line.
    """

    title: str
    colour: str
    core: str
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

    renderer("runlist", _HTML)(
        key="runlist",
        data={"sections": [_given(section) for section in sections]},
        on_toggled_change=lambda: on("toggled", toggled),
        on_alone_change=lambda: on("alone", alone),
        on_chosen_change=lambda: on("chosen", chosen),
        on_everything_change=lambda: on("everything", everything),
    )


def _given(section: Section) -> dict[str, object]:
    """As `asdict`, which takes ten times as long for it copies every number."""
    groups = [{**vars(group), "runs": [*map(vars, group.runs)]} for group in section.groups]
    return {**vars(section), "groups": groups}
