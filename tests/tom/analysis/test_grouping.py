"""Which runs are put together, and by what."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

from tom.analysis.curves import Curve, groups
from tom.analysis.settings import (
    USUAL,
    Kind,
    choices,
    kinds_of,
    natural_sort_key,
    number,
    variants,
)
from tom.learners import LEARNERS, LearnerEntry
from tom.learners.mle import MleLearner


@dataclass(frozen=True)
class Described:
    run_id: str
    settings: dict[str, str] = field(default_factory=dict)
    learner: str = "tom"
    preset: str = "paper"
    env: str = "ant"


Run: Any = Described
"""which stands in for a `RunReader`"""


RUNS: list[Any] = [
    Run("a", {"seed": "0", "tom.flow": "discounted", "model.hidden": "64", "env": "ant"}),
    Run("b", {"seed": "1", "tom.flow": "discounted", "model.hidden": "128", "env": "hopper"}),
    Run("c", {"seed": "0", "tom.flow": "stationary", "model.hidden": "64"}, preset="mended"),
    Run("d", {"seed": "0", "tom.flow": "discounted", "model.hidden": "64"}, learner="mle"),
]


def test_runs_can_be_grouped_by_what_they_differ_in() -> None:
    assert choices(RUNS) == [USUAL, "model.hidden", "seed", "tom.flow"]
    assert choices(RUNS[:1]) == [USUAL]
    # MLE's runs have a flow in their configuration that does nothing.
    assert "tom.flow" not in choices([RUNS[2], RUNS[3]])


def test_as_usual_nothing_but_the_seed_may_differ() -> None:
    assert kinds_of(RUNS) == {
        "a": Kind("tom", "paper", "model.hidden 64"),
        "b": Kind("tom", "paper", "model.hidden 128"),
        "c": Kind("tom", "mended"),
        "d": Kind("mle", "paper"),
    }


def test_a_setting_puts_runs_together_that_have_its_value() -> None:
    assert kinds_of(RUNS, "model.hidden") == {
        run_id: Kind(variant=f"model.hidden {words}")
        for run_id, words in zip("abcd", ("64", "128", "64", "64"), strict=True)
    }
    assert set(kinds_of(RUNS, "learner").values()) == {Kind("tom"), Kind("mle")}
    assert kinds_of(RUNS, "preset")["c"] == Kind(preset="mended")


def test_what_a_setting_means_nothing_to_stays_in_its_usual_group() -> None:
    found = kinds_of([*RUNS, Run("old")], "tom.flow")
    assert found["a"] == found["b"] == Kind(variant="tom.flow discounted")
    assert found["d"] == Kind("mle", "paper")
    assert found["old"].learner == "tom"


def test_groups_of_a_setting_pool_learners_and_follow_its_numbers() -> None:
    of = kinds_of(RUNS, "model.hidden")
    at = np.array([0, 10])
    curves = [
        Curve(run.run_id, "ant", run.learner, run.preset, i, at, at + i, "", of[run.run_id])
        for i, run in enumerate(RUNS)
    ]
    small, large = groups(curves)
    assert (small.kind, large.kind) == (of["a"], of["b"])
    assert [curve.run_id for curve in small.curves] == ["a", "c", "d"]
    assert small.mean.tolist() == pytest.approx([5 / 3, 10 + 5 / 3])


def test_values_that_are_numbers_are_ordered_as_such() -> None:
    assert number(Kind(variant="model.hidden 64"), "model.hidden") == 64
    assert number(Kind(variant="sac.lr 3e-4"), "sac.lr") == 3e-4
    assert number(Kind(variant="tom.flow discounted"), "tom.flow") is None
    assert number(Kind("mle", "paper"), "tom.flow") is None
    words = ["lr 0.001", "lr 3e-5", "hidden 128", "hidden 64"]
    assert sorted(words, key=natural_sort_key) == ["hidden 64", "hidden 128", "lr 3e-5", "lr 0.001"]


def test_runs_are_apart_by_settings_that_matter() -> None:
    runs = [
        Run("a", {"seed": "0", "steps": "10", "sac.lr": "1", "pmac.decay": "1"}),
        Run("b", {"seed": "1", "steps": "20", "sac.lr": "1", "pmac.decay": "2", "new": "0"}),
        Run("c", {"seed": "2", "steps": "10", "sac.lr": "2", "pmac.decay": "1"}),
    ]
    assert variants(runs[:2]) == {"a": "", "b": ""}
    assert variants(runs) == {"a": "sac.lr 1", "b": "sac.lr 1", "c": "sac.lr 2"}


def test_the_presets_own_value_is_not_named() -> None:
    def run(name: str, share: str, env: str = "hopper") -> Any:
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


def test_a_new_learners_settings_set_its_own_runs_apart(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    entry = LearnerEntry("New", lambda c, o, a, g: MleLearner(), group="rollout")
    monkeypatch.setitem(LEARNERS, "new", entry)
    for learner, apart in (("new", ["rollout.x 1", "rollout.x 2"]), ("mle", ["", ""])):
        runs = [Run(name, {"rollout.x": name}, learner=learner) for name in ("1", "2")]
        assert list(variants(runs).values()) == apart
