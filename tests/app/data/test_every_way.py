"""Every way of weighing on two axes, held against the studies' files by another path."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest

from app.data import studies
from app.data.every_way import EveryWay, every_ways

GALLERY = Path(__file__).parents[3] / "runs" / "studies"
KEY = ["env", "recording", "step"]


def of(folder: Path) -> EveryWay:
    return every_ways(studies.listing(folder))[""]


def read(study: str) -> Any:
    return pd.read_csv(GALLERY / study / "moments.csv")


def over_recordings(of_moments: Any, env: str, way: str) -> Any:
    """Mean, least and most of the medians over each recording's moments."""
    medians = of_moments.groupby(level=["env", "recording"]).median()
    return medians.groupby(level="env").agg(["mean", "min", "max"]).loc[env, way]


def test_a_way_stands_at_its_mean_over_recordings_with_their_spread():
    near = read("footprint")
    near = near[near["footprint_noise"].abs() < 1].pivot(index=KEY, columns="way")["footprint"]
    errs = read("capacity").pivot(index=KEY, columns="way")["error 200 x 4"]
    errs = errs.div(errs["uniform"], axis=0).apply(np.log)
    n = errs.groupby(level="env").size()
    assert {panel.env for panel in of(GALLERY).panels} == {*n.index}
    for panel in of(GALLERY).panels:
        assert panel.moments == n[panel.env]
        assert {one.way for one in panel.ways} == {*near} & {*errs}
        for one in panel.ways:
            for found, table in ((one.distance, near), (one.error, errs)):
                ends = over_recordings(table, panel.env, one.way)
                value, least, most = np.exp(ends) if table is errs else ends
                assert found.value == pytest.approx(value)
                if panel.recordings == 2:  # all resamples of two lie between them, some on them
                    assert (found.low, found.high) == pytest.approx((least, most))
                assert least - 1e-9 <= found.low <= found.high <= most + 1e-9


@pytest.mark.parametrize(("error", "word"), [(0.01, "Yes"), (100, "No"), (1, "In part")])
def test_the_answer_is_yes_where_a_way_is_better_on_both_axes(
    tmp_path: Path, error: float, word: str
):
    for name in ("footprint", "capacity"):
        shutil.copytree(GALLERY / name, tmp_path / name)
    table = pd.read_csv(tmp_path / "capacity" / "moments.csv")
    table.loc[table["way"] != "uniform", "error 200 x 4"] *= error
    table.to_csv(tmp_path / "capacity" / "moments.csv", index=False)
    found = of(tmp_path)
    assert found.word == word
    assert "VaGram" in found.caption  # no model was fitted with its weights
    near = pd.read_csv(tmp_path / "footprint" / "moments.csv")
    near[near["env"] == "hopper"].to_csv(tmp_path / "footprint" / "moments.csv", index=False)
    assert [panel.env for panel in of(tmp_path).panels] == ["hopper"]
    (tmp_path / "footprint" / "moments.csv").write_text("way\nuniform\n")  # of another version
    assert not every_ways(studies.listing(tmp_path))


def test_studies_whose_names_end_alike_belong_together(tmp_path: Path):
    for name, ending in (("footprint", ""), ("footprint", "-b"), ("capacity", "-b")):
        shutil.copytree(GALLERY / name, tmp_path / f"{name}{ending}")
    listed = studies.listing(tmp_path)
    assert [*every_ways(listed)] == ["-b"]
    assert every_ways(listed)["-b"] == of(GALLERY)
