"""Weighings in a store: damaged ones are passed over or named."""

import json
from pathlib import Path

from tom.reports.weighing_files import REPORT, notices, of_run

WHOLE = {"data": "one", "policy": "one", "rows": 3, "results": []}


def weighing(store: Path, name: str, report: object) -> Path:
    path = store / "weighings" / name
    path.mkdir(parents=True)
    (path / REPORT).write_text(json.dumps(report))
    return path


def test_what_is_no_whole_report_on_a_run_is_none_of_its_weighings(tmp_path: Path):
    whole = weighing(tmp_path, "whole", WHOLE)
    weighing(tmp_path, ".unfinished.1.tmp", WHOLE)
    weighing(tmp_path, "other", {**WHOLE, "data": "two"})
    weighing(tmp_path, "list", [WHOLE])
    assert of_run(tmp_path, "one") == [whole]


def test_what_holds_for_several_seeds_is_told_once():
    told = [{"learner": "tom", "seed": seed, "notices": ["odd"]} for seed in (0, 1)]
    (line,) = notices({"results": told})
    assert "0-1" in line
