"""Choices that the address keeps; each change is an entry of the browser's history, so Back works.

Streamlit's own `bind="query-params"` replaces the address in place, so Back would leave the page.
An address that the server writes to `st.query_params` is a new entry of the history, except when
Back itself caused the drawing (and one act of the visitor is one entry: app/servers/pages.py). So a
page reads its choices here (`value_of`, or a widget of this module), each with the words that the
address has for it (`write`). The address counts for what this session has no choice of.

The choices of `SHARED` belong to all pages: they last when the user goes to another page.
"""

import math
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, TypeVar

import streamlit as st
from streamlit.elements.lib.mutable_expander_container import ExpanderContainer
from streamlit.runtime.scriptrunner import get_script_run_ctx

from app import text

T = TypeVar("T")
SHARED = ("task", "find", "state", "learner", "preset", "tag", "group", "hide", "show",
          "run", "step")  # fmt: skip
multiselect: Callable[..., list[Any]] = partial(
    st.multiselect, filter_mode="contains", select_all=False
)
"""a choice of any number of options, which the address does not keep"""
_PAGE, _READ = "address: page", "address: read"


def enter_page(page: str) -> None:
    """This drawing is of `page`; on arrival there, also by Back or Forward, its address counts.

    Then the choices of before are forgotten: shared ones not if the address has none of those.
    """
    context, state = get_script_run_ctx(), st.session_state
    back = context is not None and context.is_history_navigation
    if back or state.get(_PAGE) != page:
        state[_PAGE] = page
        whole = back or any(map(st.query_params.get_all, SHARED))
        for key in state.get(_READ, ()):
            if whole or key not in SHARED:
                state.pop(key, None)


def write(key: str, values: Sequence[str]) -> None:
    """Set what the address says of a choice from now on; no words for the default choice."""
    if list(values) != st.query_params.get_all(key):
        st.query_params.update({key: values})  # no words take a choice out


def shared() -> dict[str, list[str]]:
    """The words of the address for the choices that belong to all pages."""
    return {key: words for key in SHARED if (words := st.query_params.get_all(key))}


def value_of(key: str, read: Callable[[list[str]], T], owner: object = None) -> T:
    """A choice's value: the session's, else read from the address.

    It starts anew when its `owner`, what it belongs to, has changed.
    """
    state = st.session_state
    state.setdefault(_READ, set()).add(key)
    if key not in state:
        state[key] = read(st.query_params.get_all(key))
    elif state.get(f"{key} of", owner) != owner:
        state[key] = read([])
    state[f"{key} of"] = owner
    return state[key]


def get_all(key: str, allowed: Callable[[str], bool] = bool) -> list[str]:
    """A choice without a widget that is its words, without those that are not `allowed`."""
    found = [word for word in value_of(key, list) if allowed(word)]
    write(key, found)
    return found


def get(key: str, default: str = "") -> str:
    """A choice without a widget that is one word."""
    found = "".join(value_of(key, list)[-1:]) or default
    write(key, [] if found == default else [found])
    return found


def whole_number(given: Sequence[str]) -> int | None:
    """The whole number in the last word of an address; None if there is none."""
    return text.parse_int("".join(given[-1:]))


def choose_one(
    widget: Callable[..., T | None],
    label: str,
    options: Sequence[T],
    key: str,
    default: T,
    label_of: Callable[[T], str] = str,
    owner: object = None,
    **more: Any,
) -> T:
    """The user's choice of one of `options`: a selectbox, a segmented control or a slider."""
    follow_default(key, default)
    value_of(
        key, lambda given: next(iter(_parse_options(options, given, label_of)), default), owner
    )
    if st.session_state[key] not in options:
        st.session_state[key] = default
    picked = widget(label, options, key=key, format_func=label_of, **more)
    chosen = default if picked is None else picked
    write(key, [] if chosen == default else [str(chosen)])
    return chosen


def choose_part(options: Sequence[str], key: str = "part", label: str = "Part", **more: Any) -> str:
    """The chosen part of a page, usually the first."""
    return choose_one(
        more.pop("place", st).segmented_control, label, options, key, options[0],
        required=True, label_visibility="collapsed", **more,
    )  # fmt: skip


def choose_many(
    label: str,
    options: Sequence[str],
    key: str,
    label_of: Callable[[str], str] = str,
    default: Sequence[str] = (),
    **more: Any,
) -> list[str]:
    """The user's choice of any number of `options`: a multiselect.

    Of an address no more than its `max_selections` are taken.
    """
    most = more.get("max_selections")
    follow_default(key, list(default))
    held = value_of(
        key, lambda given: _parse_options(options, given, label_of)[:most] or list(default)
    )
    st.session_state[key] = [one for one in held if one in options]
    chosen = multiselect(label, options, key=key, format_func=label_of, **more)
    write(key, [] if chosen == list(default) else chosen)
    return chosen


def number_input(
    widget: Callable[..., float | None],
    label: str,
    key: str,
    default: float,
    owner: object,
    **more: Any,
) -> float:
    """The number that the user has chosen, until its `owner`, what it belongs to, changes."""

    def read(given: list[str]) -> float:
        try:
            number = float("".join(given[-1:]))
        except ValueError:
            return default
        return number if math.isfinite(number) else default

    follow_default(key, default)
    value_of(key, read, owner)
    typed = widget(label, key=key, **more)
    number = default if typed is None else float(typed)
    write(key, [] if number == default else [f"{number:.12g}"])
    return number


def follow_default(key: str, default: object) -> None:
    """Keep an untouched choice at the usual one, where that changes with the data."""
    before = st.session_state.get(f"{key} usual", default)
    if key in st.session_state and st.session_state[key] == before:
        st.session_state[key] = default
    st.session_state[f"{key} usual"] = default


def switch(label: str, key: str) -> bool:
    """Whether the user has switched something on: a toggle."""
    value_of(key, lambda given: given[-1:] == ["true"])
    on = st.toggle(label, key=key)
    write(key, ["true"] if on else [])
    return on


def fold(label: str, key: str) -> ExpanderContainer:
    """What the user may open: an expander, which knows whether it is `open`."""
    value_of(key, lambda given: given[-1:] == ["true"])
    box = st.expander(label, key=key, on_change="rerun")
    write(key, ["true"] if box.open else [])
    return box


def text_input(label: str, key: str, **more: Any) -> str:
    value_of(key, lambda given: "".join(given[-1:]))
    typed = st.text_input(label, key=key, **more) or ""
    write(key, [typed] if typed else [])
    return typed


def _parse_options(
    options: Sequence[T], given: Sequence[str], label_of: Callable[[T], str]
) -> list[T]:
    """The options that an address names by their value or their label, in its order."""
    named = {label_of(option): option for option in options} | {str(o): o for o in options}
    return [named[word] for word in given if word in named]
