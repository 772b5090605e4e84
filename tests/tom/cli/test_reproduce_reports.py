"""What the runner makes of a study's findings: files, report, JSON and exit code."""

import json
from argparse import Namespace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from tom.cli import build_parser
from tom.cli.reproduce import run
from tom.config import RoadConfig
from tom.reports.figures import new_figure
from tom.road.offline_data import map_of
from tom.studies.road_map import Places, environment_rows, weight_figure, weight_rows
from tom.studies.study import Findings, Row, Study, Table, at_least, at_most, tasks

CHECKS = [at_least("TOM's success", 1.0, 0.8), at_most("MLE's", 0.5, 0.1)]
UNJUDGED: Row = {"name": "for comparison", "value": 3.0, "bound": "", "met": None}


def carried_out(checks: list[Row], out: Path, *, as_json: bool = False) -> int:
    """The exit code of a study that finds these checks."""
    found = Findings(
        said=["Agrees."],
        files={"numbers": [{"a": 1, "b": 0.5}]},
        figures={"drawn": ("A caption", lambda: new_figure(2, 2))},
        tables=[Table("Numbers", [{"a": 1, "b": 0.5}])],
        checks=checks,
        origin={"seeds": "0-2"},
        json={"summary": [float("nan")]},
    )
    study = Study("made-up", "Made up", None, "the claim", lambda _: None, lambda *_: found)
    return run(study, Namespace(out=out, json=as_json))


def test_what_is_met_and_what_is_not(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert carried_out([*CHECKS, UNJUDGED], tmp_path) == 1
    assert {path.name for path in tmp_path.iterdir()} == {
        "numbers.csv", "checks.csv", "drawn.png", "drawn.svg", "report.html", "report.json",
    }  # fmt: skip
    assert (tmp_path / "numbers.csv").read_text().split() == ["a,b", "1,0.5"]
    assert [str(met) for met in pd.read_csv(tmp_path / "checks.csv")["met"]] == [
        "True", "False", "nan",
    ]  # fmt: skip
    told = json.loads((tmp_path / "report.json").read_text())
    assert told["claim"] == "the claim"
    assert told["found"][0] == "Agrees."
    assert told["found"][1].startswith("1 of 2 figures")
    assert "MLE's" in told["found"][2]
    assert told["origin"]["seeds"] == "0-2"
    assert "data:image/png" in (tmp_path / "report.html").read_text()
    assert str(tmp_path) in capsys.readouterr().out


def test_all_met(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert carried_out(CHECKS[:1], tmp_path, as_json=True) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["checks"] == CHECKS[:1]
    assert told["summary"] == [None]
    assert len(told["verdict"]) == 2


def test_the_map_of_road_and_rocks(tmp_path: Path):
    rng = np.random.default_rng(0)
    of = [
        Places(name, 0, rng.random((500, 2), np.float32), rng.random(500, np.float32))
        for name in ("MLE", "TOM")
    ]
    weights = pd.DataFrame(weight_rows(of))
    names, count, mean = (weights[c].to_numpy() for c in ("learner", "transitions", "mean weight"))
    assert {name: count[names == name].sum() for name in ("MLE", "TOM")} == {"MLE": 500, "TOM": 500}
    found = np.average(mean[names == "TOM"], weights=count[names == "TOM"])
    assert found == pytest.approx(of[1].weights.mean())
    assert len(weight_figure(of).axes) == 3
    task = pd.DataFrame(environment_rows(map_of(RoadConfig(learner="tom", seed=0))))
    road, right, up = (task[column].to_numpy() for column in ("road", "dx", "dy"))
    assert set(zip(right[road], up[road], strict=True)) == {(1.0, 0.0)}
    assert (right[~road] < 0).mean() > 0.9  # rocks turn by 180 +- 90 degrees


def test_what_is_named_twice_counts_once(tmp_path: Path):
    seen: list[Namespace] = []

    def find(args: Namespace, _: object) -> Findings:
        seen.append(args)
        return Findings([], {}, {}, [])

    study = Study("made-up", "Made up", None, "", lambda _: None, find)
    run(study, Namespace(out=tmp_path, json=True, seeds=[2, 0, 2], preset="paper"))
    assert (seen[0].seeds, seen[0].preset) == ([2, 0], "paper")
    assert tasks(["hopper", "hopper", "ant", "hopper"]) == ["hopper", "ant"]
    args = build_parser(["reproduce"]).parse_args(["reproduce", "tabular", "--variant-seeds"])
    assert args.variant_seeds == []
