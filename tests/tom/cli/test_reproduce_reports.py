"""What the runner makes of a study's findings: files, report, JSON and exit code."""

import json
from argparse import Namespace
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import pandas as pd
import pytest

from tom.cli import build_parser
from tom.cli.reproduce import run
from tom.reports.figures import new_figure
from tom.studies.study import Findings, Row, check, tasks
from tom.studies.verdicts import by_acceptance

CHECKS = [check("TOM's success", 1.0, ">=", 0.8), check("MLE's", 0.5, "<=", 0.1)]
UNJUDGED: Row = {"name": "for comparison", "value": 3.0, "bound": "", "met": None}


def made_up(find: Callable[[Namespace], Findings]) -> ModuleType:
    study = ModuleType("made_up")
    vars(study).update(
        TITLE="Made up", QUESTION="Really?", CLAIM="the claim", find=find, verdict=by_acceptance
    )
    return study


def carried_out(checks: list[Row], out: Path, *, as_json: bool = False) -> int:
    """The exit code of a study that finds these checks."""
    found = Findings(
        sentences=["Agrees."],
        files={"numbers": [{"a": 1, "b": 0.5, "c": float("nan")}], "points": iter([{"a": 2}])},
        titles={"numbers": "Numbers"},
        figures={"drawn": ("A caption", new_figure(2, 2))},
        checks=checks,
        origin={"seeds": "0-2"},
    )
    study = made_up(lambda _: found)
    return run(study, Namespace(out=out, json=as_json))


def test_what_is_met_and_what_is_not(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert carried_out([*CHECKS, UNJUDGED], tmp_path) == 1
    assert {path.name for path in tmp_path.iterdir()} == {
        "numbers.csv", "points.csv", "checks.csv", "drawn.png", "drawn.svg", "report.html",
        "report.json",
    }  # fmt: skip
    assert (tmp_path / "numbers.csv").read_text().split() == ["a,b,c", "1,0.5,nan"]
    assert [str(met) for met in pd.read_csv(tmp_path / "checks.csv")["met"]] == [
        "True", "False", "nan",
    ]  # fmt: skip
    told = json.loads((tmp_path / "report.json").read_text())
    assert told["claim"] == "the claim"
    assert told["found"][0] == "Agrees."
    assert "In part" in told["found"][1]
    assert "MLE's" in told["found"][2]
    assert told["origin"]["seeds"] == "0-2"
    page, printed = (tmp_path / "report.html").read_text(), capsys.readouterr().out
    assert "data:image/png" in page
    assert str(tmp_path) in printed
    for text in (page, printed):
        assert "In part" in text


def test_all_met(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    assert carried_out(CHECKS[:1], tmp_path, as_json=True) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["checks"] == CHECKS[:1]
    assert told["numbers"] == [{"a": 1, "b": 0.5, "c": None}]
    assert len(told["verdict"]) == 2
    assert "Yes" in told["verdict"][1]


def test_a_study_with_nothing_to_judge_has_no_verdict(tmp_path: Path, capsys):
    assert carried_out([], tmp_path, as_json=True) == 0
    assert len(json.loads(capsys.readouterr().out)["verdict"]) == 1


def test_what_is_named_twice_counts_once(tmp_path: Path):
    seen: list[Namespace] = []

    def find(args: Namespace) -> Findings:
        seen.append(args)
        return Findings([], {}, {}, {})

    study = made_up(find)
    run(study, Namespace(out=tmp_path, json=True, seeds=[2, 0, 2], preset="paper"))
    assert (seen[0].seeds, seen[0].preset) == ([2, 0], "paper")
    assert tasks(["hopper", "hopper", "ant", "hopper"]) == ["hopper", "ant"]
    args = build_parser(["reproduce"]).parse_args(["reproduce", "tabular", "--variant-seeds"])
    assert args.variant_seeds == []
