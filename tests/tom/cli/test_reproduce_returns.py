"""`tom reproduce returns` and `online` on small runs."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
from common import measured

from tom.cli import main
from tom.record import Store

TRAIN = ["train", "--env", "inverted-pendulum", "--preset", "smoke", "--no-rerun", "--steps", "250"]


def record(
    store: Path,
    run_id: str,
    returns: Mapping[int, float],
    learner: str = "mle",
    preset: str = "paper",
    env: str = "hopper",
    seed: int = 0,
) -> None:
    """A run with these returns, by step."""
    steps = [(step, {"eval/return": value}) for step, value in returns.items()]
    measured(Store(store), run_id, learner, seed, *steps, env=env, preset=preset)


class Returns:
    """The study of the runs in the folder `store`."""

    def __init__(self, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
        self.store, self.out, self.capsys = folder / "store", folder / "out", capsys

    def code(self, *words: str) -> int:
        places = ("--store", str(self.store), "--out", str(self.out))
        return main(["reproduce", "returns", *places, *words])

    def found(self, *words: str) -> dict[str, Any]:
        """What the study prints as JSON."""
        self.capsys.readouterr()
        assert self.code(*words, "--json") == 0
        return json.loads(self.capsys.readouterr().out)

    def refused(self, *words: str) -> str:
        self.capsys.readouterr()
        assert self.code(*words) == 2
        return self.capsys.readouterr().err


@pytest.fixture
def study(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Returns:
    return Returns(tmp_path, capsys)


def test_a_report_of_what_the_store_has(study: Returns):
    assert main([*TRAIN, "--learner", "mle", "--store", str(study.store)]) == 0
    smoke = ("--preset", "smoke")
    found = study.found(*smoke)
    assert found["summary"][0]["n"] == 1
    of_paper = {"MLE", "PMAC", "TOM", "Ratio", "VaGram (MDN)", "VaGram (Ensemble)"}
    assert {row["learner"] for row in found["missing"]} == of_paper
    assert {path.name for path in study.out.iterdir()} == {
        "returns.png", "returns.svg", "report.html", "report.json", "returns.csv", "summary.csv",
        "improvement.csv", "factors.csv", "exams.csv", "rollouts.csv", "less.csv", "missing.csv",
    }  # fmt: skip
    assert "tom sweep --env hopper" in (study.out / "report.html").read_text()
    for at in ((), ("--at", "250"), ("--at", "inverted-pendulum=250")):
        assert study.code(*smoke, *at) == 0
    assert "ends at 250" in study.refused(*smoke, "--at", "251")


def test_who_is_left_out_is_named_where_the_table_is(study: Returns):
    """Whoever ended early may have diverged: without it the table is of the survivors."""
    record(study.store, "whole", {100: 1.0, 200: 1.0})
    record(study.store, "short", {100: 1.0}, seed=1)
    assert study.found("--at", "200")["verdict"][-1].endswith("--at: short.")
    assert not any("Left out" in line for line in study.found()["verdict"])


def test_seeds_alone(study: Returns):
    for seed in range(3):
        record(study.store, f"seed-{seed}", {100: float(seed)}, seed=seed)
    found = study.found("--seeds", "1", "2")
    (row,) = found["summary"]
    assert (row["seeds"], row["mean"]) == ("1 2", 1.5)
    assert not any("Left out" in line for line in found["verdict"])
    record(study.store, "seed-9", {}, seed=9)
    for seeds in (("9",), ("3", "4")):
        assert f"--seeds {' '.join(seeds)}" in study.refused("--seeds", *seeds)


def test_a_comparison_that_was_fixed_beforehand_is_corrected_for_no_other(study: Returns):
    kinds = (("mle", "paper"), ("pmac", "paper"), ("tom", "paper"), ("tom", "mended"))
    for place, kind in enumerate(kinds):
        for seed in range(4):
            record(study.store, f"{place}-{seed}", {100: 10.0 * place + seed}, *kind, seed=seed)

    def compared(*chosen: str) -> list[dict]:
        return study.found(*chosen)["improvement"]

    assert len(compared()) == 6 * 3
    of_two = compared("--groups", "TOM, mended", "MLE")
    assert {(row["learner"], row["against"]) for row in of_two} == {("TOM, mended", "MLE")}
    assert len(of_two) == 3
    by_compare = compared("--groups", "TOM, mended", "MLE, paper")  # as the page calls them
    assert by_compare == of_two
    (alone,) = compared("--groups", "TOM, mended", "MLE", "--by", "area")
    assert (alone["by"], alone["wins"]) == ("area under the curve", 1.0)
    assert alone["p of all"] == alone["p"] < of_two[0]["p of all"]
    (others,) = compared("--groups", "PMAC", "MLE", "--by", "area")
    assert (others["learner"], others["wins"]) == ("PMAC", 1.0)
    said = study.refused("--groups", "MLE", "TOM mended")
    assert "MLE; PMAC; TOM; TOM, mended" in said


def test_runs_of_other_groups_bound_no_planned_comparison(study: Returns):
    for learner, steps in (("pmac", (100, 500)), ("vagram", (1000, 2000)), ("ratio", (1000, 2000))):
        record(study.store, learner, {step: float(step) for step in steps}, learner)
    found = study.found("--by", "last", "--groups", "VaGram (MDN)", "Ratio")
    assert {row["at step"] for row in found["summary"]} == {2000}
    (row,) = found["improvement"]  # a comparison without MLE and TOM, because it was asked for
    assert {row["learner"], row["against"]} == {"VaGram (MDN)", "Ratio"}
    three = ("--groups", "VaGram (MDN)", "PMAC", "Ratio", "--at", "2000")
    study.refused(*three)  # no comparison of the two that are left
    assert {row["at step"] for row in study.found()["summary"]} == {500}


@pytest.mark.parametrize("at", [("hopper=2000", "1000"), ("1000", "hopper=2000")])
def test_a_step_of_one_task_counts_whatever_the_order(at: tuple[str, ...], study: Returns):
    for env in ("hopper", "walker2d"):
        record(study.store, env, {step: float(step) for step in (1000, 2000)}, env=env)
    steps = {row["env"]: row["at step"] for row in study.found("--at", *at)["summary"]}
    assert steps == {"hopper": 2000, "walker2d": 1000}


def test_a_report_of_where_weights_lie(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    store, out = tmp_path / "store", tmp_path / "out"
    assert main([*TRAIN, "--steps", "450", "--learner", "pmac", "--store", str(store)]) == 0
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
