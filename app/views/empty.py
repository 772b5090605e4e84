"""What a store without runs shows: how to get some."""

import shlex

import streamlit as st

from app import readers, session, widgets


def page() -> None:
    """Say what to run, and look again by itself."""
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
    _look_again(store)


@st.fragment(run_every=2)
def _look_again(store: str) -> None:
    if readers.listing(store).runs:
        st.rerun()
