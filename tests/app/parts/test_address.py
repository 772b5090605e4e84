"""A page's choices and its address say the same."""

import pytest
from streamlit.testing.v1 import AppTest

PAGE = """
import streamlit as st
from app.parts import address

address.visit("page")
first = address.choose_one(st.selectbox, "First", ["a", "b"], "first", "a", str.upper)
if first == "b":
    address.choose_many("Then", ["x", "y", "z"], "then", usual=["x"])
address.switch("On", "on", usual=True)
address.text_input("Words", "words")
st.session_state["seen"] = address.value_of("own", list)
address.keep("own", st.session_state["own"])
address.write()
"""


def page(**query: str | list[str]) -> AppTest:
    app = AppTest.from_string(PAGE)
    for name, value in query.items():
        app.query_params[name] = value
    return app.run()


def address(app: AppTest) -> dict[str, list[str]]:
    given = app.query_params.items()
    return {name: [words] if isinstance(words, str) else words for name, words in given}


def test_an_address_is_what_the_page_shows() -> None:
    app = page(first="B", then=["z", "y", "gone"], on="false", words="hi", own="1~2", other="kept")
    assert not app.exception
    assert (app.selectbox[0].value, app.multiselect[0].value) == ("b", ["z", "y"])
    assert (app.toggle[0].value, app.text_input[0].value) == (False, "hi")
    assert app.session_state["seen"] == ["1~2"]
    assert address(app) == {
        "first": ["b"],
        "then": ["z", "y"],
        "on": ["false"],
        "words": ["hi"],
        "own": ["1~2"],
        "other": ["kept"],
    }


def test_the_usual_is_not_in_the_address_and_what_makes_no_sense_is_taken_out() -> None:
    app = page(first="nonsense", on="true")
    assert app.selectbox[0].value == "a"
    assert address(app) == {}
    app.selectbox[0].select("b").run()
    assert app.multiselect[0].value == ["x"]
    assert address(app) == {"first": ["b"]}


def test_a_choice_that_is_no_longer_there_leaves_the_address() -> None:
    app = page(first="b", then="y")
    app.toggle[0].set_value(False).run()
    assert address(app) == {"first": ["b"], "then": ["y"], "on": ["false"]}
    app.selectbox[0].select("a").run()
    assert address(app) == {"on": ["false"]}
    app.selectbox[0].select("b").run()
    assert app.multiselect[0].value == ["y"]  # as it was left
    assert address(app) == {"first": ["b"], "then": ["y"], "on": ["false"]}
    assert not app.exception


def test_an_address_chooses_no_more_than_the_page_takes() -> None:
    script = """
import streamlit as st
from app.parts import address, pick

address.visit("page")
options = {name: name for name in "abcde"}
address.choose_many("Some", list(options), "some", max_selections=2)
pick.many("Others", options, "others", max_selections=3)
address.write()
"""
    app = AppTest.from_string(script)
    app.query_params["some"] = ["e", "gone", "d", "c"]
    app.query_params["others"] = list("abcde")
    app.run()
    assert not app.exception
    assert [choice.value for choice in app.multiselect] == [["e", "d"], ["a", "b", "c"]]
    assert address(app) == {"some": ["e", "d"], "others": ["a", "b", "c"]}


NUMBER = """
import streamlit as st
from app.parts import address

address.visit("page")
usual = st.session_state.get("usual", 1.5)
address.number_input(st.number_input, "Level", "level", usual, st.session_state.get("of"))
address.write()
"""


def level(app: AppTest) -> tuple[float | None, dict[str, list[str]]]:
    assert not app.exception
    return app.number_input[0].value, address(app)


def test_a_number_is_in_the_address_until_it_is_of_something_else() -> None:
    app = AppTest.from_string(NUMBER)
    app.query_params["level"] = "-1234567.25"
    assert level(app.run()) == (-1234567.25, {"level": ["-1234567.25"]})
    app.session_state["usual"] = 2.5
    assert level(app.run()) == (-1234567.25, {"level": ["-1234567.25"]})
    app.number_input[0].set_value(7.0).run()
    assert level(app) == (7.0, {"level": ["7"]})
    app.session_state["of"] = "another task"
    assert level(app.run()) == (2.5, {})
    app.number_input[0].set_value(7.0).run()
    app.session_state["usual"] = 7.0
    assert level(app.run()) == (7.0, {})


@pytest.mark.parametrize("word", ["", "much", "nan", "inf", "1e999"])
def test_the_usual_number_follows_the_data_and_stands_for_what_is_none(word: str) -> None:
    app = AppTest.from_string(NUMBER)
    app.query_params["level"] = word
    assert level(app.run()) == (1.5, {})
    app.session_state["usual"] = 2.5
    assert level(app.run()) == (2.5, {})


STEP = """
import streamlit as st
from app.parts import address

address.visit(st.session_state.get("page", "page"))
steps = st.session_state.get("steps", [100, 200, 300])
usual = "the end" if st.session_state.get("ends") else steps[-1]
task = st.session_state.get("task", "hopper")
st.session_state["shown"] = address.choose_step("At", steps, usual, of=task)
address.write()
"""


def at_step(step: str | None = None, **state: object) -> AppTest:
    """The page of a choice of a step, opened by a link with `step`."""
    app = AppTest.from_string(STEP)
    for name, value in state.items():
        app.session_state[name] = value
    if step is not None:
        app.query_params["step"] = step
    return app.run()


def shown(app: AppTest) -> tuple[object, dict[str, list[str]], list[str]]:
    """The step, the address, and what is said."""
    assert not app.exception
    return app.session_state["shown"], address(app), [words.value for words in app.caption]


@pytest.mark.parametrize(("asked", "nearest"), [("12", 100), ("245", 200), ("12345", 300)])
def test_in_place_of_a_step_that_was_not_kept_the_nearest_is_shown_said_and_in_the_address(
    asked: str, nearest: int
) -> None:
    app = at_step(asked)
    said = f"Step {int(asked):,} was not kept; this is the nearest, {nearest}."
    for _ in range(2):
        assert shown(app) == (nearest, {"step": [str(nearest)]}, [said])
        app.run()
    kept = at_step(str(nearest))
    assert kept.select_slider[0].value == nearest
    assert shown(kept) == (nearest, {"step": [str(nearest)]}, [])


@pytest.mark.parametrize("word", ["", "much", "-100", "1e2", "nan", "²", "9" * 30])
def test_what_is_no_step_opens_the_usual_one(word: str) -> None:
    step, _, said = shown(at_step(word))
    assert (step, said) == (300, [])


@pytest.mark.parametrize("elsewhere", [False, True])
def test_a_step_of_one_task_is_not_carried_into_another(elsewhere: bool) -> None:
    app = at_step()
    app.select_slider[0].set_value(200).run()
    other = {"task": "ant", "steps": [10, 150, 900], **({"page": "other"} if elsewhere else {})}
    for name, value in other.items():
        app.session_state[name] = value
    if elsewhere:
        del app.query_params["step"]
    step, _, said = shown(app.run())
    assert (step, said) == (900, [])
    app.select_slider[0].set_value(150).run()
    for name, value in {"task": "hopper", "steps": [100, 200, 300]}.items():
        app.session_state[name] = value
    assert shown(app.run()) == (200, {"step": ["200"]}, [])


def test_an_untouched_choice_of_a_step_follows_the_newest() -> None:
    app = at_step()
    app.session_state["steps"] = [100, 200, 300, 400]
    assert shown(app.run()) == (400, {}, [])
    app.select_slider[0].set_value(300).run()
    app.session_state["steps"] = [100, 200, 300, 400, 500]
    assert shown(app.run()) == (300, {"step": ["300"]}, [])
    app.select_slider[0].set_value(500).run()
    app.session_state["steps"] = [100, 200, 300, 400, 500, 600]
    assert shown(app.run()) == (600, {"step": ["600"]}, [])


def test_of_another_run_with_one_step_that_step_is_shown() -> None:
    app = at_step("200")
    app.session_state["steps"] = [70]
    assert shown(app.run())[:2] == (70, {"step": ["70"]})
    assert app.selectbox[0].disabled


def test_the_chosen_step_goes_along_to_another_page() -> None:
    app = at_step("100")
    app.session_state["page"], app.session_state["steps"] = "another", [120, 240]
    app.query_params.clear()
    said = "Step 100 was not kept; this is the nearest, 120."
    assert shown(app.run()) == (120, {"step": ["120"]}, [said])
    app.session_state["page"], app.session_state["steps"] = "page", [100, 200]
    app.query_params.clear()
    assert shown(app.run()) == (100, {"step": ["100"]}, [])
    app.select_slider[0].set_value(200).run()
    app.session_state["page"], app.session_state["steps"] = "another", [120, 240]
    app.query_params.clear()
    assert shown(app.run()) == (240, {}, [])


def test_the_usual_may_be_no_step() -> None:
    assert shown(at_step(ends=True)) == ("the end", {}, [])
    said = "Step 130 was not kept; this is the nearest, 100."
    app = at_step("130", ends=True)
    assert shown(app) == (100, {"step": ["100"]}, [said])
    app.select_slider[0].set_value("the end").run()
    assert shown(app) == ("the end", {}, [])
    none = at_step("130", ends=True, steps=[])
    assert shown(none) == ("the end", {}, ["Step 130 was not kept; this is the end."])


def test_a_part_of_the_page_that_is_drawn_alone_writes_its_choice() -> None:
    script = """
import streamlit as st
from app.parts import address

@st.fragment
def part():
    address.choose_one(st.selectbox, "Part", ["a", "b"], "part", "a")

address.visit("page")
part()
address.switch("Whole", "whole")
address.write()
"""
    app = AppTest.from_string(script)
    app.query_params["whole"] = "true"
    app.run()
    app.selectbox[0].select("b").run()
    assert address(app) == {"whole": ["true"], "part": ["b"]}
    assert app.toggle[0].value
