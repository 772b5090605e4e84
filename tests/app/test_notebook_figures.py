"""The figures that a notebook gets are those of the pages."""

import json
from pathlib import Path

import numpy as np
import pytest
from studio_pages import array, draw, figures
from studio_runs import PENDULUM_TOM

import tom
from app.data.regions import heaviest
from app.figures.weights import FLOOR
from tom.frames import Weighing

pytestmark = pytest.mark.usefixtures("studio")


def lines(figure) -> list[dict]:
    return json.loads(figure.to_json())["data"]


def test_a_runs_figures_are_those_of_the_pages(store: Path):
    shown = tom.studio.show(tom.load(PENDULUM_TOM, store), height=400)
    page = figures(draw("attention", run=PENDULUM_TOM))
    np.testing.assert_array_equal(
        array(lines(shown["every fit"])[0]["z"]), array(page[0]["data"][0]["z"])
    )
    last = array(lines(shown["the last fit"])[0]["y"])
    assert array(page[1]["data"][0]["y"]) == pytest.approx(last.clip(FLOOR))
    curve = lines(shown["return"])[0]
    frame = tom.load(PENDULUM_TOM, store).metrics["eval/return"].dropna()
    assert array(curve["x"]).tolist() == frame.index.tolist()
    assert array(curve["y"]) == pytest.approx(frame.to_numpy())


def test_a_weighings_figures_are_those_of_the_pages(store: Path):
    found = tom.weigh(
        PENDULUM_TOM, "random", learners=["pmac", "mle"], seeds=[0], footprint=50, store=store
    )
    shown = tom.studio.show(found)
    assert list(shown) == [
        "profiles", "the data by PMAC s0", "what sets PMAC s0's heaviest 1 % apart",
    ]  # fmt: skip
    names = [line.get("name") for line in lines(shown["profiles"])]
    assert names == ["PMAC (1 seed)", "MLE (1 seed)"]
    weight = found.weights["pmac-s0"].to_numpy()
    cells = array(lines(shown["the data by PMAC s0"])[0]["customdata"])
    assert 0.97 * len(weight) <= cells.sum() <= len(weight)  # but for the outermost
    rows = found.transitions.filter(regex=r"^(obs|action)_")
    gap = (rows[heaviest(weight, 0.01)].mean() - rows.mean()) / rows.std(ddof=0)
    bars = lines(shown["what sets PMAC s0's heaviest 1 % apart"])[0]
    assert array(bars["x"])[-1] == pytest.approx(gap[gap.abs().idxmax()], rel=1e-4)


def test_a_weighing_without_its_rows_has_its_profiles(store: Path, tmp_path: Path):
    made = tom.weigh(PENDULUM_TOM, "random", learners=["mle"], seeds=[0], footprint=50, store=store)
    found = tom.load(made.save(tmp_path / "away"))
    assert isinstance(found, Weighing)
    assert list(tom.studio.show(found)) == ["profiles"]
