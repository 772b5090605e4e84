"""Choices of runs."""

import pytest
from streamlit.testing.v1 import AppTest
from studio_pages import draw
from studio_runs import PENDULUM_TOM

pytestmark = pytest.mark.usefixtures("studio")

BOTH = [PENDULUM_TOM, "pendulum-tom-1"]


def starts_at(app: AppTest) -> str:
    """What the browser shows until it is told otherwise."""
    box = app.selectbox(key="follow")
    return box.proto.options[box.proto.default]


def test_a_choice_that_is_not_the_first_needs_no_second_message() -> None:
    # Live is drawn again every two seconds, so that on a slow machine the browser never got the
    # message that sets the choice: it showed the first run, and the address said so, too.
    app = draw("live", runs=BOTH)
    box = app.selectbox(key="follow")
    assert box.value == "pendulum-tom-1"  # the newest
    assert box.proto.options[0].endswith("seed 0")
    assert starts_at(app).endswith("seed 1")
    assert starts_at(app.run()).endswith("seed 1")


def test_so_does_a_choice_in_the_address() -> None:
    app = draw("live", runs=[*BOTH, "pendulum-mle-0"], follow=PENDULUM_TOM)
    assert app.selectbox(key="follow").value == PENDULUM_TOM
    assert starts_at(app).endswith("TOM · seed 0")


FOLLOWED = """
import streamlit as st
from app.parts import address, pick

address.visit("")
names = {name: name for name in st.session_state["offered"]}
pick.one("Follow", names, st.session_state["offered"][0], "follow")
address.write()
"""


@pytest.mark.parametrize("chosen", ["b", "c"])
def test_a_run_that_leaves_the_page_is_no_broken_link(chosen: str) -> None:
    app = AppTest.from_string(FOLLOWED)
    app.session_state["offered"] = ["b", "c"]
    app.run().selectbox(key="follow").select(chosen).run()
    app.session_state["offered"] = ["a", "b", "c"]
    assert app.run().selectbox(key="follow").value == ("a" if chosen == "b" else "c")
    app.session_state["offered"] = ["a"]
    assert app.run().selectbox(key="follow").value == "a"
    assert not app.exception
    assert not app.warning
    app = AppTest.from_string(FOLLOWED)
    app.session_state["offered"] = ["a"]
    app.query_params["follow"] = chosen
    assert len(app.run().warning) == 1
