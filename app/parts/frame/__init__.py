"""What all pages share in the browser: shortcuts, help, the theme, notices of ended trainings."""

from collections.abc import Sequence

import streamlit as st

from app import session, text
from app.data.called import names
from app.parts.component import renderer
from tom.readable import score
from tom.record.reader import RunReader

TOLD = "frame: told"
"""the ended trainings that this session knows of"""
KEYS = {
    "Space": "play or pause the timeline",
    "← →": "one fit or evaluation back or on",
    "/": "search the runs",
    "?": "this help",
    "Alt + eye": "show a run or a group alone",
    "Back": "the view before this one",
}
_HELP = "".join(f"<dt><kbd>{key}</kbd></dt><dd>{what}</dd>" for key, what in KEYS.items())
_HTML = f"""<div class="frame"><button type="button" class="theme"></button>
      <button type="button" class="help">Shortcuts</button>
      <button type="button" class="ask">Notify me when a training ends</button>
      <dialog aria-label="Shortcuts"><h2>Shortcuts</h2><dl>{_HELP}</dl>
      <form method="dialog"><button autofocus>Close</button></form></dialog></div>"""


def draw(runs: Sequence[RunReader]) -> None:
    """The buttons below the list of runs, and everything that has no place of its own."""
    called = names(runs)
    ended = [
        {
            "id": f"{run.run_id} {run.status.state}",
            "title": f"{called[run.run_id]}: {run.shown}",
            "body": run.status.reason or f"last return {score(run.status.last_return)}",
        }
        for run in runs
        if not run.status.alive and not run.small_copy
    ]
    before = st.session_state.get(TOLD)
    for one in ended:
        if before is not None and one["id"] not in before:
            st.toast(f"**{text.markdown(one['title'])}**  \n{text.markdown(one['body'])}")
    st.session_state[TOLD] = {one["id"] for one in ended}
    mode = "" if session.links().theme else session.mode()
    renderer("frame", _HTML)(key="page frame", data={"mode": mode, "ended": ended})
