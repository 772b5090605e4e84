"""What the long studies leave behind, written from outcomes made up here."""

import argparse
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tom.cli import build_parser
from tom.cli.reproduce import progression
from tom.cli.reproduce import road as reproduce_road
from tom.cli.reproduce.study import tasks
from tom.reports.style import new_figure, save
from tom.studies.checks import Check
from tom.studies.progression import Finding
from tom.studies.road import Outcome, Story


def story(name: str, seed: int) -> Story:
    """A case whose return grows, with weights over a map."""
    rng = np.random.default_rng(seed)
    numbers = rng.random(9).tolist()
    outcome = Outcome(name, seed, 60.0, *numbers, sac_return=-20.0, sac_success=1.0)
    places, weights = rng.random((500, 2), np.float32), rng.random(500, np.float32)
    return Story(outcome, [(0, -100.0), (100, -20.0 - seed)], places, weights)


def test_road_and_rocks(tmp_path: Path):
    stories = [story(name, seed) for name in ("mle", "tom") for seed in (0, 1, 2)]
    checks = [Check("TOM's success", 1.0, ">= 0.8", True), Check("MLE's", 0.5, "<= 0.1", False)]
    reproduce_road._write(tmp_path, stories, [s.outcome for s in stories], checks, ["Agrees."])
    text = (tmp_path / "report.html").read_text()
    assert "1 of 2 figures of our acceptance are met." in text
    assert "Not met: MLE&#x27;s." in text
    assert "<p>Agrees.</p>" in text
    assert text.count("data:image/png") == 4
    assert "0-2" in text
    names = {path.name for path in tmp_path.iterdir()}
    assert {"outcomes.csv", "checks.csv"} <= names
    for figure in ("environment", "returns", "sweep", "weights"):
        assert {f"{figure}.png", f"{figure}.svg", f"{figure}.csv"} <= names
    weights = pd.read_csv(tmp_path / "weights.csv")
    names, count, mean = (weights[c].to_numpy() for c in ("learner", "transitions", "mean weight"))
    assert {name: count[names == name].sum() for name in ("MLE", "TOM")} == {"MLE": 500, "TOM": 500}
    own = stories[3].weights
    assert own is not None
    found = np.average(mean[names == "TOM"], weights=count[names == "TOM"])
    assert found == pytest.approx(own.mean())
    task = pd.read_csv(tmp_path / "environment.csv")
    road, right, up = (task[column].to_numpy() for column in ("road", "dx", "dy"))
    assert set(zip(right[road], up[road], strict=True)) == {(1.0, 0.0)}
    assert (right[~road] < 0).mean() > 0.9  # rocks turn by 180 +- 90 degrees


def test_weight_progression_judges_its_first_preset(tmp_path: Path):
    figure = new_figure(2, 2)
    save(figure, tmp_path, "progression")
    args = argparse.Namespace(out=tmp_path, preset=["exact", "paper"], seeds=[0, 1])
    asked = ("own", "tom", "random half")
    numbers = [
        Finding("hopper", "exact", *asked, (0.1, 0.1), ("<=", 0.2)),
        Finding("hopper", "paper", *asked, (9.0, 9.0), ("<=", 0.2)),
    ]
    progression._report(numbers, ["Agrees."], args)
    text = (tmp_path / "report.html").read_text()
    assert "1 of 1 figures of our acceptance are met." in text
    assert "hopper, own policy, tom, random half" in text
    assert "<p>Agrees.</p>" in text


@pytest.mark.parametrize(
    ("study", "option", "values", "kept"),
    [
        ("progression", "--seeds", ["0", "0", "1"], [0, 1]),
        ("progression", "--sac-seeds", ["1", "1"], [1]),
        ("progression", "--preset", ["exact", "exact", "paper"], ["exact", "paper"]),
        ("focus", "--seeds", ["2", "0", "2"], [2, 0]),
        ("tabular", "--seeds", ["3", "3"], [3]),
        ("tabular", "--variant-seeds", [], []),
        ("road", "--sweep-seeds", ["4", "4"], [4]),
    ],
)
def test_a_value_that_is_named_twice_counts_once(
    study: str, option: str, values: list[str], kept: list[object]
):
    args = build_parser(["reproduce"]).parse_args(["reproduce", study, option, *values])
    assert getattr(args, option.strip("-").replace("-", "_")) == kept


def test_a_task_that_is_named_twice_counts_once():
    assert tasks(["hopper", "hopper", "ant", "hopper"]) == ["hopper", "ant"]
