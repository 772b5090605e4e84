"""The part of each figure that is shown, in the address: `zoom=hopper~0~50000~-100~3000`.

The environment, low and high along x, low and high along y; empty where all of an axis is shown.
"""

import math
from collections.abc import Mapping, Sequence

import streamlit as st

from app.parts import address
from app.parts.plot import View

ZOOM, OF = "zoom", "zoom of"
ALL = View()


def views(measured: object) -> dict[str, View]:
    """The part of each environment's figure that the reader or the address has chosen.

    A zoom is one of what was `measured`, so that it goes when that changes.
    """
    arrived = address.told(ZOOM) is not None
    found = address.held(ZOOM, read)
    if not arrived and st.session_state.get(OF, measured) != measured:
        found = st.session_state[ZOOM] = {}
    st.session_state[OF] = measured
    address.keep(ZOOM, [word(env, view) for env, view in found.items()])
    return found


def keep(found: Mapping[str, View]) -> None:
    """These parts of the environments' figures are shown from now on."""
    st.session_state[ZOOM] = dict(found)


def zoomed(found: Mapping[str, View], env: str, view: View) -> dict[str, View]:
    """With another part shown of the figure of an environment, or all of it again."""
    others = {name: seen for name, seen in found.items() if name != env}
    return others if view == ALL else others | {env: view}


def word(env: str, view: View) -> str:
    """A figure's zoom as the address has it."""
    ends = [*(view.x or ("", "")), *(view.y or ("", ""))]
    return "~".join([env, *(end if isinstance(end, str) else f"{end:.5g}" for end in ends)])


def read(words: Sequence[str]) -> dict[str, View]:
    """The zoom of each environment, of those that an address names and that can be read."""
    found = {env: View(part(ends[:2]), part(ends[2:])) for env, ends in map(_split, words)}
    return {env: view for env, view in found.items() if view != ALL}


def part(ends: Sequence[str]) -> tuple[float, float] | None:
    """Low and high, to the five digits that the address keeps; None where they are no range."""
    try:
        low, high = (float(f"{float(end):.5g}") for end in ends)
    except ValueError:
        return None
    return (low, high) if math.isfinite(low) and math.isfinite(high) and low < high else None


def _split(word: str) -> tuple[str, list[str]]:
    env, *ends = word.rsplit("~", 4)
    return env, ends if len(ends) == 4 else []
