"""The step of all panels, and the numbers that follow it in the browser."""

import json

import pytest
from streamlit.testing.v1 import AppTest

PAGE = """
import streamlit as st
from app.parts import address, timeline

address.enter_page("page")
stops = st.session_state.get("stops", [100, 200, 300])
step = timeline.chosen_step(stops)
st.session_state["shown"] = step
timeline.draw(stops[::2], stops[1::2], step)
"""


def at(step: str | None = None, **state: object) -> AppTest:
    app = AppTest.from_string(PAGE)
    for name, value in state.items():
        app.session_state[name] = value
    if step is not None:
        app.query_params["step"] = step
    return app.run()


def shown(app: AppTest) -> tuple[int, object]:
    """The step, and the address's words for it."""
    assert not app.exception
    (drawn,) = [json.loads(part.proto.json) for part in app.get("bidi_component")]
    assert drawn["step"] == app.session_state["shown"]
    return drawn["step"], dict(app.query_params.items()).get("step")


@pytest.mark.parametrize(("asked", "step"), [("12", 100), ("245", 200), ("12345", 300)])
def test_the_last_stop_that_is_not_after_what_is_asked_is_shown(asked: str, step: int) -> None:
    app = at(asked)
    for _ in range(2):
        found, address = shown(app)
        assert found == step
        assert address in ((None,) if step == 300 else (str(step), [str(step)]))
        app.run()


@pytest.mark.parametrize("word", ["", "much", "-100", "1e2", "nan", "²", "9" * 30])
def test_what_is_no_step_is_the_end_which_grows_with_a_training(word: str) -> None:
    app = at(word)
    assert shown(app) == (300, None)
    app.session_state["stops"] = [100, 200, 300, 400]
    assert shown(app.run()) == (400, None)


def test_a_chosen_step_stays_while_a_training_grows_and_where_another_run_is_shown() -> None:
    app = at()
    app.session_state["step"] = 200  # as the hand does
    assert shown(app.run())[0] == 200
    for stops, step in (([100, 200, 300, 400], 200), ([150, 900], 150), ([70], 70), ([300], 300)):
        app.session_state["stops"] = stops
        assert shown(app.run())[0] == step
