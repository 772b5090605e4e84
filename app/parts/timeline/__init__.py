"""The page's timeline: fits and evaluations of a run, and the step that all panels show.

Panels follow it in the browser (`app.parts.plot.Follow`, `numbers`), at its frame rate; the server
draws the page again when the hand stops.
"""

from collections.abc import Sequence

import streamlit as st

from app import parts
from app.parts import address

STEP = "step"
_HTML = """<div class="timeline" role="group" aria-label="Timeline">
      <button type="button" aria-label="Play"><svg viewBox="0 0 24 24" width="16"
        aria-hidden="true"><path fill="currentColor" d="M7 4.5v15l12.5-7.5Z"/></svg></button>
      <div class="track"><div class="marks"></div><div class="hand"></div>
        <input type="range" step="1" aria-label="Step of the training"></div>
      <output aria-live="off"></output>
      <span class="key">| fit &nbsp; &#8226; evaluation</span></div>"""
Number = tuple[str, Sequence[str], str]
"""a label, the number's text at each step, and what it is"""


def chosen_step(stops: Sequence[int]) -> int:
    """The step that the user or the address has chosen, else the last of `stops`, which grow.

    It is one of `stops` (ascending, at least one): the last that is not after what was asked for.
    """
    asked = address.value_of(STEP, address.whole_number)
    before = [stop for stop in stops if asked is None or stop <= asked]
    step = before[-1] if before else stops[0]
    address.write(STEP, [] if step == stops[-1] else [str(step)])
    return step


def go_to(step: int) -> None:
    """Show this step from the next drawing on."""
    st.session_state[STEP] = step


def draw(fits: Sequence[int], evaluations: Sequence[int], step: int) -> None:
    """The timeline at the bottom of the window; it stands at `step`."""
    stops = sorted({*fits, *evaluations})

    def on_step(moved: float) -> None:
        # At its end it goes on following a run that trains.
        st.session_state[STEP] = None if moved == stops[-1] else int(moved)

    given = {"stops": stops, "fits": list(fits), "evaluations": list(evaluations)}
    with st.bottom:
        parts.draw("timeline", _HTML, "timeline", {"given": given, STEP: step}, step=on_step)


def numbers(steps: Sequence[int], shown: Sequence[Number]) -> None:
    """Show numbers at the last of `steps` (ascending) that is not after the timeline's step."""
    labelled = [{"label": label, "values": of, "help": words} for label, of, words in shown]
    data = {"steps": list(steps), "numbers": labelled}
    parts.draw("readout", '<dl class="readout"></dl>', "numbers", data)
