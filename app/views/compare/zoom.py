"""The shown part of each figure, in the address: `zoom=hopper~0~50000~-100~3000`.

That is the environment, low and high along x, low and high along y; both ends of an axis are empty
if all of it is shown.
"""

import math
from collections.abc import Mapping, Sequence

import streamlit as st

from app.parts import address
from app.parts.plot import View

ZOOM, OF = "zoom", "zoom of"
ALL = View()


def views(measured: object) -> dict[str, View]:
    """The part of each environment's figure that the user or the address has chosen.

    A zoom belongs to what was `measured` and is dropped when that changes.
    """
    arrived = address.requested(ZOOM) is not None
    seen = address.value_of(ZOOM, from_words)
    if not arrived and st.session_state.get(OF, measured) != measured:
        seen = st.session_state[ZOOM] = {}
    st.session_state[OF] = measured
    address.keep(ZOOM, [to_word(env, view) for env, view in seen.items()])
    return seen


def remember(seen: Mapping[str, View]) -> None:
    """Show these parts of the environments' figures from now on."""
    st.session_state[ZOOM] = dict(seen)


def zoomed(seen: Mapping[str, View], env: str, view: View) -> dict[str, View]:
    """`seen` with another part of one environment's figure, or with all of it again."""
    others = {name: shown for name, shown in seen.items() if name != env}
    return others if view == ALL else others | {env: view}


def to_word(env: str, view: View) -> str:
    """A figure's zoom as a word of the address."""
    ends = [*(view.x or ("", "")), *(view.y or ("", ""))]
    return "~".join([env, *(end if isinstance(end, str) else f"{end:.5g}" for end in ends)])


def from_words(words: Sequence[str]) -> dict[str, View]:
    """The zoom of each environment from the words of an address; malformed words are left out."""
    seen = {env: View(part(ends[:2]), part(ends[2:])) for env, ends in map(_split, words)}
    return {env: view for env, view in seen.items() if view != ALL}


def part(ends: Sequence[str]) -> tuple[float, float] | None:
    """Low and high, to the five digits that the address keeps; None if they are not a range."""
    try:
        low, high = (float(f"{float(end):.5g}") for end in ends)
    except ValueError:
        return None
    return (low, high) if math.isfinite(low) and math.isfinite(high) and low < high else None


def _split(word: str) -> tuple[str, list[str]]:
    env, *ends = word.rsplit("~", 4)
    return env, ends if len(ends) == 4 else []
