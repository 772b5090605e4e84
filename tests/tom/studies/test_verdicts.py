"""The words of verdicts follow from the tables by the stated rule."""

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from tom.reports.report import read_csv, read_tables
from tom.studies import STUDIES, capacity, load, two_axes
from tom.studies.verdicts import Tables, Verdict, verdict_of

GALLERY = Path(__file__).parents[3] / "runs" / "studies"


def of(name: str, **changed: Any) -> Verdict:
    """The verdict of a study of the gallery, or of one with these tables, `_` for `-`."""
    tables: Tables = read_tables((GALLERY / name).glob("*.csv"))
    other = {key.replace("_", "-"): table.to_dict("records") for key, table in changed.items()}
    found = verdict_of(load(name.partition("-")[0]), {**tables, **other})
    assert found is not None
    return found


def read(name: str, table: str) -> Any:
    return read_csv(GALLERY / name / f"{table}.csv")


def on_two_axes(near: Any, errs: Any) -> Verdict:
    return two_axes.verdict(near.to_dict("records"), errs.to_dict("records"))


@pytest.mark.parametrize(
    ("line", "way"), [("TOM mended", "tom-mended"), ("TOM as printed", "tom-discounted")]
)
def test_the_distances_are_medians_over_moments_averaged_over_recordings_and_tasks(
    line: str, way: str
):
    moments = read("footprint", "moments")
    told = moments[(moments["way"] == way) & (moments["footprint_noise"].abs() < 1)]
    medians = told.groupby(["env", "recording"])["footprint"].median()
    [point] = [point for point in of("footprint").points if point.line == line]
    assert point.value == pytest.approx(medians.groupby(level="env").mean().mean(), rel=1e-6)
    assert point.low < point.value < point.high < 1
    assert of("footprint").word == "Yes"


def test_what_speaks_against_has_the_rival_s_distance_and_test():
    table, summary = read("footprint", "head-to-head"), read("footprint", "summary")
    row = (table["way"] == "tom-mended") & (table["against"] == "recency")
    assert row.any()
    table.loc[row, ["better on", "recordings", "p"]] = 1, 7, 0.123
    [distance] = summary.loc[summary["way"] == "recency", "distance"]
    against = of("footprint", head_to_head=table).against
    assert all(number in against for number in (f"{distance:.2f}", "1 of 7", "0.12"))


@pytest.mark.parametrize("recordings", [2, 4])
def test_errors_that_differ_by_chance_alone_seldom_give_an_answer(recordings: int):
    rng, ways, models = np.random.default_rng(0), ("tom-discounted", "tom-mended"), range(4)
    words = []
    for _ in range(40):
        rows = []
        for env in ("hopper", "walker2d", "halfcheetah"):
            for one in range(recordings):
                trial = {"env": env, "recording": f"{env} {one}", "step": 0, "seed": 0}
                rows.append({**trial, "way": "uniform", **{f"error {m}": 1.0 for m in models}})
                for way in ways:
                    errors = {f"error {m}": np.exp(rng.normal(0, 0.1)) for m in models}
                    rows.append({**trial, "way": way, **errors})
        words.append(capacity.verdict({"head-to-head": capacity.head_to_head(rows)}).word)
    assert words.count("No difference seen") >= 36


def test_no_answer_is_given_where_the_recordings_disagree():
    early = read("capacity-early", "head-to-head")
    of_tom = early[(early["way"] == "tom-mended") & (early["against"] == "uniform")]
    assert of_tom["better on"].between(2, 4).all()  # of six
    assert of("capacity-early").word == "No difference seen"
    errs = read("capacity-early", "moments")
    assert on_two_axes(read("footprint-early", "moments"), errs).word == "No difference seen"


def test_the_least_p_is_corrected_for_all_tests_that_are_shown():
    table = read("capacity", "head-to-head")
    shown = table.loc[table["against"] == "uniform", "p"]
    found = of("capacity")
    assert found.word == "No difference seen"  # small models gain, but p is .06 after correction
    assert len(found.points) == len(shown)
    assert f"{len(shown) * min(shown):.2g}" in found.against


def test_a_study_without_tom_is_judged_by_the_ways_it_has():
    found = of("capacity-ways")
    assert {point.series for point in found.points} == {"policy distance", "PMER"}
    assert found.word == "No difference seen"  # one errs more, on five of six recordings
    assert "PMER" in found.question
    assert "TOM" not in found.question
    assert not of("capacity").question  # the study's own
    assert of("footprint-ways").word == "Yes"


@pytest.mark.parametrize(
    ("wins", "p", "word"),
    [(0.9, 0.01, "Yes"), (0.1, 0.01, "No"), (0.9, 0.2, "No difference seen")],
)
def test_returns_are_judged_by_the_corrected_p(wins: float, p: float, word: str):
    table = read("returns", "improvement")
    table.loc[table["learner"].str.startswith("TOM"), ["wins", "p of all"]] = wins, p
    assert of("returns", improvement=table).word == word


@pytest.mark.parametrize(("p", "word"), [(0.01, "In part"), (0.2, "No difference seen")])
def test_model_and_starts_are_judged_by_the_corrected_p(p: float, word: str):
    table = read("returns-apart-40000", "factors")
    starts = (table["effect of"] == "weighted starts") & (table["by"] == "area under the curve")
    table.loc[starts, ["effect", "p of all"]] = 123.4, p
    found = of("returns-apart-40000", factors=table)
    assert found.word == word
    assert 123.4 in [point.value for point in found.points]
    assert "+123" in found.sentence


def test_no_trial_s_share_is_beyond_chance():
    found = of("improvement")
    assert found.word == "No difference seen"
    table = read("improvement", "summary").dropna(subset="p")
    shares = table["better in trials"] / table["n"]
    assert [point.value for point in found.points] == pytest.approx([*shares])
    better = table["better in trials"].astype(int)
    assert f" {better.min()} of 44 " in found.sentence
    assert f" {better.max()} of 44 " in found.sentence


@pytest.mark.parametrize(
    ("shares", "word"), [((0.9, 0.8, 0.2), "No"), ((0.1, 0.2, 0.9), "Yes"), ((0.1, 0.9), "In part")]
)
def test_profiles_are_judged_by_where_most_of_them_lie(shares: tuple[float, ...], word: str):
    rows = [("ant", "TOM", step, share / 2, share, "r") for step, share in enumerate(shares)]
    rows.append(("ant", "TOM", 9, 0.1, np.nan, "r"))
    columns = ["env", "learner", "step", "newest tenth", "excess there", "run"]
    found = of("online", online=pd.DataFrame(rows, columns=columns))
    assert found.word == word
    assert f"{sum(share < 0.5 for share in shares)} of {len(shares)} " in found.sentence
    assert [point.value for point in found.points] == [
        pytest.approx(np.median([*(share / 2 for share in shares), 0.1]))
    ]


@pytest.mark.parametrize("name", STUDIES)
def test_tables_of_another_version_have_no_verdict(name: str):
    other = {key: [{"a": 1}] for key in ("summary", "online", "improvement", "checks")}
    assert verdict_of(load(name), {}) is None
    assert verdict_of(load(name), other) is None


KEY = ["env", "recording", "step"]


def over_recordings(of_moments: Any, env: str, way: str) -> Any:
    """Mean, least and most of the medians over each recording's moments."""
    medians = of_moments.groupby(level=["env", "recording"]).median()
    return medians.groupby(level="env").agg(["mean", "min", "max"]).loc[env, way]


def test_a_way_stands_at_its_mean_over_recordings_with_their_spread():
    near, errs = read("footprint", "moments"), read("capacity", "moments")
    panels = on_two_axes(near, errs).panels
    near = near[near["footprint_noise"].abs() < 1].pivot(index=KEY, columns="way")["footprint"]
    errs = errs.pivot(index=KEY, columns="way")["error 200 x 4"]
    errs = errs.div(errs["uniform"], axis=0).apply(np.log)
    n = near.dropna(how="all").groupby(level="env").size()
    assert (n <= errs.groupby(level="env").size()).all()  # of some moments the distance is noise
    assert {panel.env for panel in panels} == {*n.index}
    for panel in panels:
        assert panel.moments == n[panel.env]
        assert {way for way, *_ in panel.ways} == {*near} & {*errs}
        for way, distance, error in panel.ways:
            for found, table in ((distance, near), (error, errs)):
                ends = over_recordings(table, panel.env, way)
                value, least, most = np.exp(ends) if table is errs else ends
                assert found.value == pytest.approx(value)
                if panel.recordings == 2:  # all resamples of two lie between them, some on them
                    assert (found.low, found.high) == pytest.approx((least, most))
                assert least - 1e-9 <= found.low <= found.high <= most + 1e-9


@pytest.mark.parametrize(("error", "word"), [(0.01, "Yes"), (100, "No"), (1, "No difference seen")])
def test_the_answer_is_yes_where_a_way_is_better_on_both_axes(error: float, word: str):
    near, errs = read("footprint", "moments"), read("capacity", "moments")
    errs.loc[errs["way"] != "uniform", "error 200 x 4"] *= error
    found = on_two_axes(near, errs)
    assert found.word == word
    assert "VaGram" in found.caption  # no model was fitted with its weights
    of_hopper = on_two_axes(near[near["env"] == "hopper"], errs)
    assert [panel.env for panel in of_hopper.panels] == ["hopper"]
    with pytest.raises(ValueError, match="nothing to judge"):
        on_two_axes(near, errs[:0])
