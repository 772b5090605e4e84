"""The figures that a notebook gets are those of the pages."""

import json
from pathlib import Path

import numpy as np
import pytest
from studio_pages import array, draw, figures
from studio_runs import PENDULUM_TOM

import tom

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
    assert array(page[1]["data"][0]["y"]) == pytest.approx(last)
    curve = lines(shown["return"])[0]
    frame = tom.load(PENDULUM_TOM, store).metrics["eval/return"].dropna()
    assert array(curve["x"]).tolist() == frame.index.tolist()
    assert array(curve["y"]) == pytest.approx(frame.to_numpy())
