"""The runs that all pages are about: the list at the left, its search, its groups and its eyes."""

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
from common import change
from streamlit.testing.v1 import AppTest
from studio_pages import draw
from studio_runs import PENDULUM_TOM, altered, info, trains_elsewhere

from app.data import readers
from app.parts import scope
from app.parts.scope import Scope, matching
from tom.analysis.grouping import CUT_SHORT, SHOWN_GROUPS
from tom.analysis.settings import USUAL
from tom.record import layout, manage
from tom.record.reader import RunReader
from tom.record.store import Store

pytestmark = pytest.mark.usefixtures("studio")
PENDULUM, SECOND, MLE = "inverted-pendulum", "pendulum-tom-1", "pendulum-mle-0"


@pytest.fixture
def state(monkeypatch: pytest.MonkeyPatch) -> dict[str, list[str]]:
    """What the eyes change."""
    eyes: dict[str, list[str]] = {"hide": [], "show": []}
    monkeypatch.setattr(scope.st, "session_state", eyes)
    monkeypatch.setattr(scope.address, "value_of", lambda key, _: eyes.get(key, []))
    monkeypatch.setattr(scope.address, "write", lambda *_: None)
    return eyes


def pendulums(store: Path) -> list[RunReader]:
    return [run for run in readers.listing(str(store)).runs if run.env == PENDULUM]


def shown(found: Scope) -> list[str]:
    return sorted(run.run_id for run in found.shown)


def groups(app: AppTest) -> dict[str, dict]:
    """The groups of the list by their titles, of all its sections."""
    protos = [part.proto for part in app.get("bidi_component")]
    (drawn,) = [json.loads(p.json) for p in protos if p.component_name == "tom_runlist"]
    return {group["title"]: group for part in drawn["sections"] for group in part["groups"]}


def test_an_eye_hides_and_shows_a_run_or_a_group(store: Path, state: dict[str, list[str]]) -> None:
    runs = pendulums(store)

    def after(act: Callable[[Scope, str], None], word: str) -> list[str]:
        act(scope._scope(runs, USUAL), word)
        return shown(scope._scope(runs, USUAL))

    assert after(scope.toggle, SECOND) == [MLE, PENDULUM_TOM]
    assert after(scope.toggle, "TOM") == [MLE]
    assert after(scope.toggle, PENDULUM_TOM) == [MLE, PENDULUM_TOM]  # opened with its group
    assert after(scope.toggle, SECOND) == [MLE, PENDULUM_TOM, SECOND]
    assert state == {"hide": [], "show": []}
    assert after(scope._show_alone, SECOND) == [SECOND]
    assert after(scope._show_alone, "MLE") == [MLE]
    assert after(scope.toggle, "TOM") == [MLE, PENDULUM_TOM, SECOND]


def test_groups_beyond_the_first_are_folded_until_they_are_opened(
    store: Path, state: dict[str, list[str]]
) -> None:
    one = info(store, PENDULUM_TOM)
    runs = [altered(one, run_id=f"run-{i}", learner=f"own {i}") for i in range(SHOWN_GROUPS + 2)]
    found = scope._scope(runs, USUAL)
    assert len(found.shown) == SHOWN_GROUPS
    folded = sorted(found.folded)
    assert found.hidden == found.folded
    scope.toggle(found, folded[0])
    assert state == {"hide": [], "show": folded[:1]}
    found = scope._scope(runs, USUAL)
    assert len(found.shown) == SHOWN_GROUPS + 1
    scope.toggle(found, folded[0])
    assert shown(scope._scope(runs, USUAL)) == shown(scope._scope(runs, USUAL))
    assert len(scope._scope(runs, USUAL).shown) == SHOWN_GROUPS


def test_examples_are_folded_beside_runs_of_ones_own(
    store: Path, state: dict[str, list[str]]
) -> None:
    own = info(store, PENDULUM_TOM)
    example = altered(info(store, MLE), small_copy=True)
    assert shown(scope._scope([own, example], USUAL)) == [PENDULUM_TOM]
    assert shown(scope._scope([example], USUAL)) == [MLE]
    assert state == {"hide": [], "show": []}


def test_an_example_never_counts_in_a_group_of_ones_own_runs(
    store: Path, state: dict[str, list[str]]
) -> None:
    own = info(store, PENDULUM_TOM)
    alike = altered(own, run_id="an example of the same settings", small_copy=True)
    found = scope._scope([own, alike], USUAL)
    assert shown(found) == [PENDULUM_TOM]
    scope.toggle(found, found.title(alike))
    groups = scope._scope([own, alike], USUAL).comparable()
    assert sorted(map(len, groups.values())) == [1, 1]


@pytest.mark.usefixtures("state")
def test_a_run_that_ended_well_before_the_others_does_not_count_unless_it_goes_on(
    store: Path,
) -> None:
    whole, other = info(store, PENDULUM_TOM), info(store, SECOND)
    end = whole.status.env_step
    for at, state, cut in (
        (CUT_SHORT * end - 1, "stopped", True),
        (CUT_SHORT * end + 1, "stopped", False),
        (1, "finished", False),
    ):
        status = replace(other.status, env_step=int(at), state=state)
        found = scope._scope([whole, altered(other, status=status)], USUAL)
        assert [run.run_id for run in found.cut_short] == [SECOND] * cut
        assert (SECOND in shown(found)) != cut


@pytest.mark.usefixtures("state")
def test_one_run_is_the_chosen_one_else_the_most_usual_of_those_that_are_shown(
    store: Path, state: dict[str, list[str]]
) -> None:
    runs = pendulums(store)

    def one(suits: Callable[[RunReader], bool] = lambda run: True) -> str:
        found = scope._scope(runs, USUAL).choose_run(suits, lambda run: run.run_id)
        return found.run_id if found else ""

    assert one() == MLE
    state["run"] = [SECOND]
    assert one() == SECOND
    assert one(lambda run: run.run_id != SECOND) == MLE
    state["run"], state["hide"] = ["no such run"], [MLE]
    assert one() == PENDULUM_TOM
    assert one(lambda run: run.learner == "mle") == MLE  # a hidden one, as no other suits
    assert one(lambda run: False) == ""


def test_a_search_is_a_regular_expression_in_names_and_ids() -> None:
    found = groups(draw("curves", task=PENDULUM, find="TOM-[1-9]$"))
    assert [run["run_id"] for run in found["TOM"]["runs"]] == [SECOND]
    assert draw("curves", task=PENDULUM, find="[").warning
    assert not groups(draw("curves", task=PENDULUM, find="no such run"))


def test_a_name_in_a_link_cannot_hold_the_studio_up(store: Path) -> None:
    run = info(store, PENDULUM_TOM)
    longest = altered(run, run_id="a" * 100)  # a backtracking search would never end
    assert matching([longest], "(a+)+!") == []
    assert matching([longest, run], "^a+$") == [longest]


def test_the_list_has_names_colours_states_and_returns(own: Path) -> None:
    for name, preset in (("a", "paper"), ("b", "mended")):
        folder = shutil.copytree(own / PENDULUM_TOM, own / name)
        change(folder / layout.CONFIG, run_id=name, preset=preset)
    found = groups(draw("curves", task=PENDULUM, hide=["TOM mended", SECOND], run="a"))
    assert {"TOM smoke", "TOM paper", "TOM mended", "MLE"} == set(found)
    assert [title for title, group in found.items() if group["hidden"]] == ["TOM mended"]
    by_id = {run["run_id"]: run for group in found.values() for run in group["runs"]}
    assert {run_id for run_id, run in by_id.items() if run["hidden"]} == {SECOND}
    assert {run_id for run_id, run in by_id.items() if run["chosen"]} == {"a"}
    assert by_id["a"]["name"] == "TOM paper s0"
    assert by_id["a"]["state"] == "finished"
    assert by_id["a"]["returns"]
    drawn = [found[title] for title in ("TOM paper", "TOM mended", "MLE")]
    assert len({(group["colour"], group["core"]) for group in drawn}) == 3


def test_a_group_counts_also_the_runs_that_the_list_does_not_name(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(scope, "LISTED", 1)
    found = groups(draw("curves", task=PENDULUM, hide=SECOND))
    counts = {title: (group["count"], group["left"]) for title, group in found.items()}
    assert counts == {"TOM": (2, 1), "MLE": (1, 1)}
    assert sum(len(group["runs"]) for group in found.values()) == 1


def test_filters_leave_the_runs_of_a_learner_or_a_state(own: Path) -> None:
    trains_elsewhere(own / SECOND)
    assert set(groups(draw("curves", task=PENDULUM, learner="mle"))) == {"MLE"}
    (group,) = groups(draw("curves", task=PENDULUM, state="running")).values()
    assert [run["run_id"] for run in group["runs"]] == [SECOND]


def test_a_filter_stays_when_the_last_training_of_its_state_ends(own: Path) -> None:
    trains_elsewhere(own / SECOND)
    app = draw("curves", task=PENDULUM, state="running")
    change(own / SECOND / layout.STATUS, state="failed", reason="it broke")
    assert not groups(app.run())
    assert app.query_params["state"] == "running"


def test_the_end_of_a_training_is_told_once(own: Path) -> None:
    trains_elsewhere(own / SECOND)
    app = draw("curves", task=PENDULUM)
    assert not app.toast
    change(own / SECOND / layout.STATUS, state="failed", reason="it broke")
    app.run()
    (told,) = app.toast
    assert "it broke" in told.value
    assert not app.run().toast


def test_every_page_is_drawn_again_when_a_run_goes_on_and_has_fitted(store: Path, tmp_path: Path):
    run = shutil.copytree(store / PENDULUM_TOM, tmp_path / PENDULUM_TOM)
    ended = scope.store_state(str(tmp_path))
    trains_elsewhere(run)
    before = scope.store_state(str(tmp_path))
    assert before != ended
    assert scope.store_state(str(tmp_path)) == before
    manage.label(Store(tmp_path), PENDULUM_TOM, name="ours")
    labelled = scope.store_state(str(tmp_path))
    assert labelled != before
    path = run / layout.PROFILES
    last = json.loads(path.read_text().splitlines()[-1])
    with path.open("a") as file:
        file.write(json.dumps(last | {"env_step": last["env_step"] + 1}) + "\n")
    assert scope.store_state(str(tmp_path)) != labelled
