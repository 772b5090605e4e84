"""Messages instead of missing content: an empty store, parts that a small copy lacks."""

import shlex
from collections.abc import Sequence

import streamlit as st

from app import session
from app.data import readers, weighings
from app.parts import again, widgets
from tom.record.reader import RunReader

EVALUATIONS = "evaluations"
"""what a small copy lacks that has no replay"""


def page() -> None:
    """Show the commands to start with, and check the store again regularly."""
    store = session.links().store
    st.header("Nothing recorded yet", anchor=False)
    st.write("Training fills this studio. In another terminal:")
    option = f" --store {shlex.quote(store)}"
    st.code(f"tom demo --headless{option}", language="bash")
    st.caption("Road and rocks with three learners, then inverted pendulum: about five minutes.")
    st.code(f"tom train --env inverted-pendulum --learner tom{option}", language="bash")
    st.code(f"tom train --env road-and-rocks --learner tom{option}", language="bash")
    st.caption("One training. It appears on the Live page as soon as it has begun.")
    st.text(f"Store: {store}")
    widgets.show_store_problems(readers.listing(store).problems)
    again.when_changed(lambda: bool(readers.listing(store).runs or weighings.datasets(store)), 2)


def left_out(run: RunReader, *parts: str) -> bool:
    """Show which of these parts a small copy lacks; returns False if none.

    One that lacks `other snapshots` may lack all of them.
    """
    names = [name for part in parts for name in (part, part.removeprefix("other "))]
    lacking = [name for name in dict.fromkeys(names) if name in run.left_out]
    if lacking:
        st.caption(f"Left out of this small copy: {', '.join(lacking)}.")
    return bool(lacking)


def left_out_of_all(runs: Sequence[RunReader], part: str) -> bool:
    """Show how many small copies lack a part; returns False if none does."""
    lacking = sum(part in run.left_out for run in runs)
    if lacking:
        copies = "the small copy" if lacking == 1 else f"the {lacking} small copies"
        st.info(f"Left out of {copies} in this store: {part}.", icon=":material/content_cut:")
    return lacking > 0
