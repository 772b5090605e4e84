"""Choices that the address keeps; each change is an entry of the browser's history, so Back works.

Streamlit's own `bind="query-params"` replaces the address in place, so that Back leaves the page.
What the server writes to `st.query_params` is an entry of its own; a drawing that Back itself asked
for adds none. So a page reads its choices here (`told`, or a widget of this module), says what each
has become (`keep`), and puts all of them into the address at its end (`write`), in one step.
"""

from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import streamlit as st
from streamlit.runtime.scriptrunner import get_script_run_ctx

T = TypeVar("T")
_PAGE, _ARRIVED = "address: page", "address: arrived"
_KEPT, _KEEPING = "address: kept", "address: keeping"


def visit(page: str) -> None:
    """This drawing is of `page`: where the last one was of another, the address counts again."""
    st.session_state[_ARRIVED] = st.session_state.get(_PAGE) != page
    st.session_state[_PAGE] = page
    st.session_state[_KEEPING] = {}  # of a drawing that was broken off


def told(key: str) -> list[str] | None:
    """What the address says of a choice where it counts, else None: the reader's own choice does.

    It counts when a page is come to, by a link or by Back and Forward.
    """
    if key in st.session_state and not (st.session_state.get(_ARRIVED) or _went_back()):
        return None
    return st.query_params.get_all(key)


def keep(key: str, words: Sequence[str]) -> None:
    """What the address shall say of a choice from now on; nothing of the usual one."""
    st.session_state.setdefault(_KEEPING, {})[key] = list(words)


def write() -> None:
    """Put the choices of this drawing into the address; those that it no longer has are gone."""
    keeping: dict[str, list[str]] = st.session_state.pop(_KEEPING, {})
    kept = st.session_state.get(_KEPT, set())
    for key in kept - keeping.keys():
        st.session_state.pop(key, None)
    st.session_state[_KEPT] = set(keeping)
    before = {key: st.query_params.get_all(key) for key in st.query_params}
    others = {key: words for key, words in before.items() if key not in kept | keeping.keys()}
    after = others | {key: words for key, words in keeping.items() if words}
    if after != before and not st.session_state.get(_ARRIVED):
        st.query_params.from_dict(after)


def one(
    widget: Callable[..., T | None],
    label: str,
    options: Sequence[T],
    key: str,
    usual: T,
    shown: Callable[[T], str] = str,
    **more: Any,
) -> T:
    """One of `options`, in a selectbox, a segmented control or a slider."""
    given = told(key)
    if given is not None:
        st.session_state[key] = next(iter(_among(options, given, shown)), usual)
    elif st.session_state[key] not in options:
        st.session_state[key] = usual
    chosen = widget(label, options, key=key, format_func=shown, **more)
    found = usual if chosen is None else chosen
    keep(key, [] if found == usual else [str(found)])
    return found


def many(
    label: str,
    options: Sequence[str],
    key: str,
    shown: Callable[[str], str] = str,
    usual: Sequence[str] = (),
    **more: Any,
) -> list[str]:
    """Any number of `options`."""
    given = told(key)
    if given is not None:
        st.session_state[key] = _among(options, given, shown) or list(usual)
    st.session_state[key] = [one for one in st.session_state[key] if one in options]
    found = st.multiselect(
        label, options, key=key, format_func=shown, filter_mode="contains", select_all=False, **more
    )
    keep(key, [] if found == list(usual) else found)
    return found


def switch(label: str, key: str, *, usual: bool = False) -> bool:
    """Whether something is so."""
    given = told(key)
    if given is not None:
        st.session_state[key] = given[-1].lower() == "true" if given else usual
    on = st.toggle(label, key=key)
    keep(key, [] if on == usual else [str(on).lower()])
    return on


def words(label: str, key: str, **more: Any) -> str:
    """What somebody writes."""
    given = told(key)
    if given is not None:
        st.session_state[key] = "".join(given[-1:])
    found = st.text_input(label, key=key, **more) or ""
    keep(key, [found] if found else [])
    return found


def held(key: str, read: Callable[[list[str]], T]) -> T:
    """What is no widget's: read from the address where it counts, else as the page has left it."""
    given = told(key)
    if given is not None:
        st.session_state[key] = read(given)
    return st.session_state[key]


def _among(options: Sequence[T], given: Sequence[str], shown: Callable[[T], str]) -> list[T]:
    """The options that an address names, as they are kept or as they are shown, in its order."""
    named = {shown(option): option for option in options} | {str(o): o for o in options}
    return [named[word] for word in given if word in named]


def _went_back() -> bool:
    """Back or Forward has asked for this drawing."""
    context = get_script_run_ctx()
    return context is not None and context.is_history_navigation
