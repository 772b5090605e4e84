"""What sets runs apart, and what does not."""

from dataclasses import dataclass

import pytest

from app.data import tables
from app.parts.form import sections
from tom.analysis.settings import NONE, differences, telling_presets, variants
from tom.config import in_words
from tom.learners import LEARNERS, LearnerEntry
from tom.learners.mle import MleLearner


@dataclass(frozen=True)
class Run:
    run_id: str
    settings: dict[str, str]
    env: str = "ant"
    learner: str = "tom"
    preset: str = "paper"


def test_a_configuration_is_flat_words() -> None:
    config = {"seed": 1, "sac": {"lr": 3e-4, "target_entropy": None}, "x": True}
    assert in_words(config) == {
        "seed": "1",
        "sac.lr": "0.0003",
        "sac.target_entropy": "none",
        "x": "true",
    }
    assert in_words("damaged") == {}


def test_only_differences_are_shown() -> None:
    runs = [Run("a", {"x": "1", "y": "2"}), Run("b", {"x": "1", "y": "3", "z": "4"})]
    assert differences(runs) == {"y": ["2", "3"], "z": [NONE, "4"]}
    frame = tables.settings(runs, ["one", "one"])
    assert list(frame.columns) == ["setting", "one", "one (2)"]
    assert frame.loc[0].tolist() == ["y", "2", "3"]
    assert tables.settings(runs[:1], ["one"]).empty


def test_runs_are_apart_by_settings_that_matter() -> None:
    runs = [
        Run("a", {"seed": "0", "steps": "10", "sac.lr": "1", "pmac.decay": "1"}),
        Run("b", {"seed": "1", "steps": "20", "sac.lr": "1", "pmac.decay": "2", "new": "0"}),
        Run("c", {"seed": "2", "steps": "10", "sac.lr": "2", "pmac.decay": "1"}),
    ]
    assert variants(runs[:2]) == {"a": "", "b": ""}
    assert variants(runs) == {"a": "sac.lr 1", "b": "sac.lr 1", "c": "sac.lr 2"}


def test_the_presets_own_value_is_not_named() -> None:
    def run(name: str, share: str, env: str = "hopper") -> Run:
        return Run(name, {"model.uniform_share": share, "tom.q_lr": "1"}, env=env, preset="mended")

    assert variants([run("a", "0.0"), run("b", "1.0"), run("c", "0.5")]) == {
        "a": "",
        "b": "model.uniform_share 1.0",
        "c": "model.uniform_share 0.5",
    }
    # No code of this task is here to say what its preset is.
    assert variants([run("a", "0.0", "nowhere:Task-v0"), run("b", "1.0", "nowhere:Task-v0")]) == {
        "a": "model.uniform_share 0.0",
        "b": "model.uniform_share 1.0",
    }


def test_a_preset_is_told_where_its_learner_has_several() -> None:
    runs = [
        Run("a", {}),
        Run("b", {}, preset="mended"),
        Run("c", {}, learner="mle"),
        Run("d", {}, env="hopper"),
    ]
    assert telling_presets(runs) == ["paper", "mended", "", ""]


@pytest.fixture
def newcomer(monkeypatch: pytest.MonkeyPatch) -> str:
    """A registered learner that reads a group of settings of its own."""
    entry = LearnerEntry("New", lambda c, o, a, g: MleLearner(), group="rollout")
    monkeypatch.setitem(LEARNERS, "new", entry)
    return "new"


def test_a_new_learners_settings_set_only_its_own_runs_apart(newcomer: str) -> None:
    for learner, apart in ((newcomer, ["rollout.x 1", "rollout.x 2"]), ("mle", ["", ""])):
        runs = [Run(name, {"rollout.x": name}, learner=learner) for name in ("1", "2")]
        assert list(variants(runs).values()) == apart


def test_a_new_learners_settings_are_shown_for_it_alone(newcomer: str) -> None:
    shown = {name: sections("hopper", name, "paper") for name in (newcomer, "mle", "tom")}
    assert [name for name, groups in shown.items() if "rollout" in groups] == [newcomer]


def test_every_learner_is_shown_the_settings_that_it_reads() -> None:
    groups = {name: set(sections("hopper", name, "paper")) for name in LEARNERS}
    own = {name: groups[name] & {"tom", "pmac", "vagram"} for name in LEARNERS}
    assert own["mle"] == set()
    assert own["ratio"] == own["tom"] == {"tom"}
    assert own["vagram"] == own["vagram-ensemble"] == {"vagram"}
