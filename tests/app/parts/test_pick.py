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
