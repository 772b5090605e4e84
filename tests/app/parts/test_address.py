"""A page's choices and its address say the same."""

import pytest
from streamlit.testing.v1 import AppTest

PAGE = """
import streamlit as st
from app.parts import address

address.enter_page("page")
first = address.choose_one(st.selectbox, "First", ["a", "b"], "first", "a", str.upper)
if first == "b":
    address.choose_many("Then", ["x", "y", "z"], "then", default=["x"])
address.switch("On", "on")
address.text_input("Words", "words")
st.session_state["seen"] = address.value_of("own", list)
address.write("own", st.session_state["own"])
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
    app = page(first="B", then=["z", "y", "gone"], on="true", words="hi", own="1~2", other="kept")
    assert not app.exception
    assert (app.selectbox[0].value, app.multiselect[0].value) == ("b", ["z", "y"])
    assert (app.toggle[0].value, app.text_input[0].value) == (True, "hi")
    assert app.session_state["seen"] == ["1~2"]
    assert address(app) == {
        "first": ["b"],
        "then": ["z", "y"],
        "on": ["true"],
        "words": ["hi"],
        "own": ["1~2"],
        "other": ["kept"],
    }


def test_the_usual_is_not_in_the_address_and_what_makes_no_sense_is_taken_out() -> None:
    app = page(first="nonsense", on="false")
    assert app.selectbox[0].value == "a"
    assert address(app) == {}
    app.selectbox[0].select("b").run()
    assert app.multiselect[0].value == ["x"]
    assert address(app) == {"first": ["b"]}


def test_a_choice_that_is_not_drawn_for_a_while_is_what_it_was() -> None:
    app = page(first="b", then="y")
    app.toggle[0].set_value(True).run()
    assert address(app) == {"first": ["b"], "then": ["y"], "on": ["true"]}
    app.selectbox[0].select("a").run()
    assert address(app) == {"then": ["y"], "on": ["true"]}
    app.selectbox[0].select("b").run()
    assert app.multiselect[0].value == ["y"]  # as it was left
    assert address(app) == {"first": ["b"], "then": ["y"], "on": ["true"]}
    assert not app.exception


def test_an_address_chooses_no_more_than_the_page_takes() -> None:
    script = """
import streamlit as st
from app.parts import address

address.enter_page("page")
address.choose_many("Some", list("abcde"), "some", max_selections=2)
"""
    app = AppTest.from_string(script)
    app.query_params["some"] = ["e", "gone", "d", "c"]
    app.run()
    assert not app.exception
    assert app.multiselect[0].value == ["e", "d"]
    assert address(app) == {"some": ["e", "d"]}


def test_an_untouched_choice_of_many_is_the_usual_one_of_other_data() -> None:
    script = """
import streamlit as st
from app.parts import address

address.enter_page("page")
usual = st.session_state.get("usual", ["a", "b"])
address.choose_many("Some", st.session_state.get("there", list("abc")), "some", default=usual)
"""
    app = AppTest.from_string(script).run()

    def of(there: str, usual: str) -> list[str]:
        app.session_state["there"], app.session_state["usual"] = list(there), list(usual)
        app.run()
        assert not app.exception
        return app.multiselect[0].value

    assert of("ad", "a") == ["a"]  # a task of which less was recorded
    assert of("abc", "ab") == ["a", "b"]
    assert of("xyz", "xy") == ["x", "y"]
    assert address(app) == {}
    app.multiselect[0].set_value(["x"]).run()
    assert of("xyz", "yz") == ["x"]
    assert address(app) == {"some": ["x"]}


NUMBER = """
import streamlit as st
from app.parts import address

address.enter_page("page")
usual = st.session_state.get("usual", 1.5)
address.number_input(st.number_input, "Level", "level", usual, st.session_state.get("of"))
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


SHARED = """
import streamlit as st
from app.parts import address

address.enter_page(st.session_state.get("page", "one"))
address.choose_one(st.selectbox, "Task", ["ant", "hopper"], "task", "ant")
address.choose_one(st.selectbox, "Own", ["a", "b"], "own", "a")
"""


def goes(app: AppTest, page: str, **query: str) -> tuple[object, object, dict[str, list[str]]]:
    """The shared choice, the page's own and the address after a visit to a page's link."""
    app.session_state["page"] = page
    app.query_params.clear()
    for name, value in query.items():
        app.query_params[name] = value
    app.run()
    assert not app.exception
    return app.selectbox[0].value, app.selectbox[1].value, address(app)


def test_shared_choices_go_along_to_another_page_and_its_own_do_not() -> None:
    app = AppTest.from_string(SHARED)
    assert goes(app, "one", task="hopper", own="b")[:2] == ("hopper", "b")
    assert goes(app, "two") == ("hopper", "a", {"task": ["hopper"]})
    app.selectbox[0].select("ant").run()
    assert goes(app, "one") == ("ant", "a", {})


def test_a_link_with_a_shared_choice_counts_on_arrival() -> None:
    app = AppTest.from_string(SHARED)
    goes(app, "one", task="hopper")
    assert goes(app, "two", task="ant")[0] == "ant"
    app.selectbox[0].select("hopper").run()
    # Another shared choice is in the link: it is a whole view, which has the usual task.
    assert goes(app, "one", find="mine")[0] == "ant"
