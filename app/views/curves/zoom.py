"""The shown part of the panels, in the address: `zoom=~0~50000` and `zoom=eval/return~-100~3000`.

All panels share the x axis, whose word has no name; each has its own y axis.
"""

import math
from collections.abc import Mapping, Sequence

import streamlit as st

from app.parts import address
from app.parts.plot import View

ZOOM, OF = "zoom", "zoom of"
Part = tuple[float, float]


def parts(measured: object) -> dict[str, Part]:
    """The shown part of each y axis by its metric, and of the x axis by the empty name.

    A zoom belongs to what was `measured` and is dropped when that changes.
    """
    arrived = address.requested(ZOOM) is not None
    seen = address.value_of(ZOOM, from_words)
    if not arrived and st.session_state.get(OF, measured) != measured:
        seen = st.session_state[ZOOM] = {}
    st.session_state[OF] = measured
    address.keep(ZOOM, [f"{name}~{low:.5g}~{high:.5g}" for name, (low, high) in seen.items()])
    return seen


def view(seen: Mapping[str, Part], metric: str) -> View:
    """The shown part of a metric's panel."""
    return View(seen.get(""), seen.get(metric))


def remember(seen: Mapping[str, Part], metric: str, shown: View) -> None:
    """Show this part of a metric's panel from now on, and the same x axis in all others."""
    changed = {name: part for name, part in seen.items() if name not in ("", metric)}
    changed |= {name: part for name, part in (("", shown.x), (metric, shown.y)) if part}
    st.session_state[ZOOM] = changed


def from_words(words: Sequence[str]) -> dict[str, Part]:
    """The parts that the words of an address name; malformed words are left out."""
    seen = {}
    for word in words:
        name, *ends = word.rsplit("~", 2)
        try:
            low, high = map(float, ends)
        except ValueError:
            continue
        if math.isfinite(low) and math.isfinite(high) and low < high:
            seen[name] = low, high
    return seen
