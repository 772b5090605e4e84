"""`tom reproduce online` on a small run that was trained for real."""

import json
from pathlib import Path

import pytest

from tom.cli import main

TRAIN = ["train", "--env", "inverted-pendulum", "--preset", "smoke", "--no-rerun", "--steps", "450"]


def test_a_report_of_what_the_store_has(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    store, out = tmp_path / "store", tmp_path / "out"
    assert main([*TRAIN, "--learner", "pmac", "--store", str(store)]) == 0
    words = ["reproduce", "online", "--store", str(store), "--out", str(out), "--preset", "smoke"]
    capsys.readouterr()
    assert main([*words, "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert {row["learner"] for row in found["online"]} == {"PMAC"}
    assert {path.name for path in out.iterdir()} == {
        *("online.png", "online.svg", "online.csv", "profiles.csv", "report.html", "report.json"),
    }
    assert "hours of training" in (out / "report.html").read_text()
    assert main(words) == 0
