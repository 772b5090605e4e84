"""Commands that pages have started: their progress, a button that ends them, why they failed."""

import re
from collections.abc import Callable, Sequence

import streamlit as st

from app import session, text
from app.data import trainings
from app.data.trainings import Started

REFRESH_S = 2


@st.cache_resource(show_spinner=False)
def started_commands() -> dict[str, Started]:
    """The last command of each name, one dict for all pages of this studio."""
    return {}


def start(name: str, arguments: Sequence[str]) -> Started:
    """Start `tom WORDS`; `name` says what for."""
    started_commands()[name] = trainings.start(arguments)
    return started_commands()[name]


def is_running(name: str) -> bool:
    """Whether the last command of this name goes on."""
    return name in started_commands() and started_commands()[name].process.poll() is None


def show(name: str, done: Callable[[], object] = lambda: None) -> None:
    """The progress of a command, or the last lines of one that failed.

    When it is done, `done` is called and the page drawn again.
    """
    if name not in started_commands():
        return
    if is_running(name):
        _progress(name)
    elif started_commands()[name].process.returncode:
        st.error(f"{text.markdown(name)} failed:", icon=":material/error:")
        st.code(started_commands()[name].tail(), language=None)
    else:
        started_commands().pop(name)
        done()
        st.rerun()


@st.fragment(run_every=REFRESH_S)
def _progress(name: str) -> None:
    if not is_running(name):
        st.rerun()
    last = (started_commands()[name].tail().splitlines()[-1:] or ["started"])[0]
    left, right = st.columns([5, 1], vertical_alignment="center")
    found = re.search(r"(\d+) of (\d+)", last)
    share = min(int(found[1]) / max(int(found[2]), 1), 1.0) if found else 0.0
    left.progress(share, f"{text.markdown(name)}: {text.markdown(last)}")
    if not session.read_only_reason() and right.button("Stop", key=f"stop {name}", width="stretch"):
        process = started_commands().pop(name).process  # a study keeps what it has finished
        process.terminate()
        process.wait()
        st.rerun()
