"""Choices that the address keeps; each change is an entry of the browser's history, so Back works.

Streamlit's own `bind="query-params"` replaces the address in place, so Back would leave the page.
An address that the server writes to `st.query_params` is a new entry of the history, except when
Back itself caused the drawing. So a page reads its choices here (`value_of`, or a widget of this
module), each with the words that the address has for it (`keep`), and at the end of the drawing
the router puts all of them into the address in one step (`write`).

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
many: Callable[..., list[Any]] = partial(st.multiselect, filter_mode="contains", select_all=False)
"""a choice of any number of options, which the address does not keep"""
_PAGE, _ARRIVED = "address: page", "address: arrived"
_KEPT, _KEEPING, _LEFT = "address: kept", "address: keeping", "address: left"


def visit(page: str) -> None:
    """This drawing is of `page`; if the last one was of another page, the address counts again."""
    st.session_state[_ARRIVED] = st.session_state.get(_PAGE) != page
    st.session_state[_PAGE] = page
    st.session_state[_KEEPING] = {}  # drop those of an interrupted drawing


def requested(key: str) -> list[str] | None:
    """The words of the address for a choice; None if the user's own choice counts instead.

    The address counts when the user arrives at a page by a link, or by Back or Forward. A shared
    choice lasts on arrival at another page by an address without any shared choice. A choice that
    this page drew before, and then did not draw for a while, is what it was.
    """
    words, context = st.query_params.get_all(key), get_script_run_ctx()
    if context is not None and context.is_history_navigation:  # Back or Forward
        return words
    if st.session_state.get(_ARRIVED):
        shared = key in SHARED and key in st.session_state
        return None if shared and not any(map(st.query_params.get_all, SHARED)) else words
    left = st.session_state.get(_LEFT, {}).get(key, words)
    return None if key in st.session_state else left


def keep(key: str, words: Sequence[str]) -> None:
    """Set what the address says of a choice from now on; no words for the default choice."""
    st.session_state.setdefault(_KEEPING, {})[key] = list(words)
    context = get_script_run_ctx()
    if context is not None and context.fragment_ids_this_run:
        write()  # the router draws whole pages


def write() -> None:
    """Put the choices of this drawing into the address, and remove those that it no longer has."""
    keeping: dict[str, list[str]] = dict(st.session_state.get(_KEEPING, {}))
    kept: dict[str, list[str]] = st.session_state.get(_KEPT, {})
    arrived = st.session_state.get(_ARRIVED, False)
    left: dict[str, list[str]] = {} if arrived else dict(st.session_state.get(_LEFT, {}))
    for key in kept.keys() - keeping.keys() - set(SHARED):
        st.session_state.pop(key, None)
        if not arrived:  # else it is of the page's last visit
            left[key] = kept[key]
    st.session_state[_LEFT] = {key: left[key] for key in left.keys() - keeping.keys()}
    st.session_state[_KEPT] = keeping
    st.session_state[_ARRIVED] = False  # a fragment may be drawn next
    words_of: dict[str, list[str]] = {key: [] for key in kept} | keeping
    changed = {key: of for key, of in words_of.items() if of != st.query_params.get_all(key)}
    if changed:
        st.query_params.update(changed)  # no words take a choice out


def shared() -> dict[str, list[str]]:
    """The words of this drawing for the choices that belong to all pages."""
    keeping = st.session_state.get(_KEEPING, {})
    return {key: keeping[key] for key in SHARED if keeping.get(key)}


def value_of(key: str, read: Callable[[list[str]], T], of: object = None) -> T:
    """A choice's value: read from the address if it counts, else the session's.

    It is that of no words when `of`, what it belongs to, is something else than it was.
    """
    given = requested(key)
    changed = st.session_state.get(f"{key} of", of) != of
    if changed and given != st.query_params.get_all(key):
        given = []
    st.session_state[f"{key} of"] = of
    if given is not None:
        st.session_state[key] = read(given)
    return st.session_state[key]


def words(key: str, among: Callable[[str], bool] = bool) -> list[str]:
    """A choice without a widget that is its words, without those that are not `among`."""
    found = [word for word in value_of(key, list) if among(word)]
    keep(key, found)
    return found


def word(key: str, usual: str = "") -> str:
    """A choice without a widget that is one word."""
    found = "".join(value_of(key, list)[-1:]) or usual
    keep(key, [] if found == usual else [found])
    return found


def whole_number(given: Sequence[str]) -> int | None:
    """The whole number in the last word of an address; None if there is none."""
    return text.whole("".join(given[-1:]))


def choose_one(
    widget: Callable[..., T | None],
    label: str,
    options: Sequence[T],
    key: str,
    usual: T,
    shown: Callable[[T], str] = str,
    **more: Any,
) -> T:
    """The user's choice of one of `options`: a selectbox, a segmented control or a slider."""
    follow(key, usual)
    value_of(key, lambda given: next(iter(_among(options, given, shown)), usual))
    if st.session_state[key] not in options:
        st.session_state[key] = usual
    picked = widget(label, options, key=key, format_func=shown, **more)
    chosen = usual if picked is None else picked
    keep(key, [] if chosen == usual else [str(chosen)])
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
    shown: Callable[[str], str] = str,
    usual: Sequence[str] = (),
    **more: Any,
) -> list[str]:
    """The user's choice of any number of `options`: a multiselect.

    Of an address no more than its `max_selections` are taken.
    """
    most = more.get("max_selections")
    held = value_of(key, lambda given: _among(options, given, shown)[:most] or list(usual))
    st.session_state[key] = [one for one in held if one in options]
    chosen = many(label, options, key=key, format_func=shown, **more)
    keep(key, [] if chosen == list(usual) else chosen)
    return chosen


def number_input(
    widget: Callable[..., float | None], label: str, key: str, usual: float, of: object, **more: Any
) -> float:
    """The number that the user has chosen, until `of`, what it belongs to, is something else."""

    def read(given: list[str]) -> float:
        try:
            number = float("".join(given[-1:]))
        except ValueError:
            return usual
        return number if math.isfinite(number) else usual

    follow(key, usual)
    value_of(key, read, of)
    typed = widget(label, key=key, **more)
    number = usual if typed is None else float(typed)
    keep(key, [] if number == usual else [f"{number:.12g}"])
    return number


def follow(key: str, usual: object) -> None:
    """Keep an untouched choice at the usual one, where that changes with the data."""
    before = st.session_state.get(f"{key} usual", usual)
    if key in st.session_state and st.session_state[key] == before:
        st.session_state[key] = usual
    st.session_state[f"{key} usual"] = usual


def switch(label: str, key: str, *, usual: bool = False) -> bool:
    """Whether the user has switched something on: a toggle."""
    value_of(key, lambda given: given[-1].lower() == "true" if given else usual)
    on = st.toggle(label, key=key)
    keep(key, [] if on == usual else [str(on).lower()])
    return on


def fold(label: str, key: str) -> ExpanderContainer:
    """What the user may open: an expander, which knows whether it is `open`."""
    value_of(key, lambda given: given[-1:] == ["true"])
    box = st.expander(label, key=key, on_change="rerun")
    keep(key, ["true"] if box.open else [])
    return box


def text_input(label: str, key: str, **more: Any) -> str:
    value_of(key, lambda given: "".join(given[-1:]))
    typed = st.text_input(label, key=key, **more) or ""
    keep(key, [typed] if typed else [])
    return typed


def _among(options: Sequence[T], given: Sequence[str], shown: Callable[[T], str]) -> list[T]:
    """The options that an address names by their value or their label, in its order."""
    named = {shown(option): option for option in options} | {str(o): o for o in options}
    return [named[word] for word in given if word in named]
