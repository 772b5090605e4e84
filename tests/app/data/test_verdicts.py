"""Findings' words follow from the tables by the stated rule."""

import csv
import shutil
from pathlib import Path

import numpy as np
import pytest

from app.data import studies
from app.data.verdicts import Verdict, verdict

GALLERY = Path(__file__).parents[3] / "runs" / "studies"


def of(name: str, folder: Path = GALLERY) -> Verdict:
    found = verdict(next(one for one in studies.listing(folder) if one.name == name))
    assert found is not None
    return found


def rows(name: str, table: str, folder: Path = GALLERY) -> list[dict[str, str]]:
    return list(csv.DictReader((folder / name / table).read_text().splitlines()))


def test_the_distances_are_medians_over_moments_averaged_over_recordings_and_tasks():
    moments = rows("footprint", "moments.csv")
    for line, way in (("TOM mended", "tom-mended"), ("TOM as printed", "tom-discounted")):
        tasks: dict[str, dict[str, list[float]]] = {}
        for row in moments:
            if row["way"] == way and abs(float(row["footprint_noise"])) < 1:  # tells something
                of_task = tasks.setdefault(row["env"], {})
                of_task.setdefault(row["recording"], []).append(float(row["footprint"]))
        typical = [np.mean([np.median(one) for one in of.values()]) for of in tasks.values()]
        point = next(point for point in of("footprint").points if point.line == line)
        assert point.value == pytest.approx(np.mean(typical), rel=1e-6)
        assert point.low < point.value < point.high < 1
    assert of("footprint").word == "Yes"


def test_the_least_p_is_corrected_for_all_tests_that_are_shown():
    shown = [
        float(row["p"])
        for row in rows("capacity", "head-to-head.csv")
        if row["against"] == "uniform"
    ]
    found = of("capacity")
    assert found.word == "In part"  # small models gain, the paper's loses
    assert len(found.points) == len(shown)
    assert f"{len(shown) * min(shown):.2g}" in found.against


def test_a_study_without_tom_is_judged_by_the_ways_it_has():
    found = of("capacity-ways")
    assert {point.learner for point in found.points} == {"policy-distance", "pmer"}
    assert found.word == "No"  # one errs more, the other no less
    assert of("footprint-ways").word == "Yes"


@pytest.mark.parametrize(
    ("wins", "p", "word"),
    [(0.9, 0.01, "Yes"), (0.1, 0.01, "No"), (0.9, 0.2, "No difference seen")],
)
def test_returns_are_judged_by_the_corrected_p(tmp_path: Path, wins: float, p: float, word: str):
    shutil.copytree(GALLERY / "returns", tmp_path / "returns")
    table = rows("returns", "improvement.csv", tmp_path)
    for row in table:
        if row["learner"].startswith("TOM"):
            row |= {"wins": str(wins), "p of all": str(p)}
    with (tmp_path / "returns" / "improvement.csv").open("w") as file:
        writer = csv.DictWriter(file, list(table[0]))
        writer.writeheader()
        writer.writerows(table)
    assert of("returns", tmp_path).word == word


def test_no_trial_s_share_is_beyond_chance():
    found = of("improvement")
    assert found.word == "No difference seen"
    shares = [
        float(row["better in trials"]) / float(row["n"])
        for row in rows("improvement", "summary.csv")
        if row["p"]
    ]
    assert [point.value for point in found.points] == pytest.approx(shares)


@pytest.mark.parametrize(
    ("name", "met", "word"),
    [
        ("road", ["True", "True", ""], "Yes"),
        ("tabular", ["True", "False"], "In part"),
        ("progression", ["False", "False", ""], "No"),
    ],
)
def test_an_acceptance_is_judged_by_the_numbers_that_are_met(
    tmp_path: Path, name: str, met: list[str], word: str
):
    (tmp_path / name).mkdir()
    lines = [f"number {i},{one}" for i, one in enumerate(met)]
    (tmp_path / name / "checks.csv").write_text("\n".join(["name,met", *lines]))
    found = of(name, tmp_path)
    assert (found.word, bool(found.against)) == (word, "False" in met)
    assert [f"number {i}" in found.against for i, one in enumerate(met)] == [
        one == "False" for one in met
    ]


@pytest.mark.parametrize(
    ("recordings", "shares", "word"),
    [(7, (0.5, 0.5), "Yes"), (7, (2.0, 0.5), "In part"), (4, (0.5, 0.5), "No difference seen")],
)
def test_a_models_error_is_judged_by_a_sign_test_over_recordings(
    tmp_path: Path, recordings: int, shares: tuple[float, float], word: str
):
    (tmp_path / "focus").mkdir()
    rows = [
        f"hopper-s{i},{rival},{share},3"
        for i in range(recordings)
        for rival, share in zip(("mle", "tom paper", "tom mended"), (1.0, *shares), strict=True)
    ]
    head = "recording,rival,policy / mle,random / mle"
    (tmp_path / "focus" / "summary.csv").write_text("\n".join([head, *rows]))
    found = of("focus", tmp_path)
    assert found.word == word  # 2 / 2 ** 7 for each of two presets, 2 / 2 ** 4
    assert sorted({point.value for point in found.points}) == sorted({*shares})
    assert f"{2 / 2**recordings:.2g}" in found.against


def test_a_study_without_a_rule_or_with_other_tables_has_no_verdict(tmp_path: Path):
    (tmp_path / "footprint").mkdir()
    (tmp_path / "online").mkdir()
    for name in ("footprint", "online"):
        (tmp_path / name / "summary.csv").write_text("a,b\n1,2\n")
    assert [verdict(study) for study in studies.listing(tmp_path)] == [None, None]
