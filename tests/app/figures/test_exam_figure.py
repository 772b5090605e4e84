"""A point a fit: the figure's numbers are those of the exams."""

from dataclasses import replace
from typing import Any

import numpy as np
from plotly.graph_objects import Figure

from app.data.exams import Exams
from app.figures.exams import FITS, footprint_error_return
from app.theme import learner_colour, learner_symbol

NAN = float("nan")
TOM = Exams(
    "run-a", "tom", 4, "TOM",
    step=np.array([100, 200, 300]),
    error=np.array([0.5, 0.25, 0.125]),
    rollout_error=np.array([1.0, 0.5, NAN]),
    footprint=np.array([0.75, -8.0, 1.25]),
    noise=np.array([0.25, -10.0, -0.5]),
    returns=np.array([10.0, 20.0, NAN]),
)  # fmt: skip
MLE = replace(TOM, run_id="run-b", learner="mle", group="MLE", footprint=np.ones(3))


def points(figure: Figure, learner: str) -> list[Any]:
    """The learner's traces: footprints, returns."""
    return list(figure.select_traces({"meta": learner}))


def test_every_fit_is_a_point_in_its_learners_colour() -> None:
    figure = footprint_error_return([TOM, MLE], 300)
    left, right = points(figure, "tom")
    assert list(left["x"]) == [0.75, 1.25]  # the second says nothing
    assert list(left["y"]) == [0.5, 0.125]
    assert list(right["x"])[:2] == [10, 20]
    assert list(right["y"]) == [0.5, 0.25, 0.125]
    assert left["marker"]["symbol"] == learner_symbol("tom")
    every: list[Any] = list(figure.data)
    keys = [one for one in every if one.meta is None]
    assert [key["marker"]["color"] for key in keys] == [
        learner_colour("tom"),
        learner_colour("mle"),
    ]
    assert list(points(figure, "mle")[0]["x"]) == [1, 1]


def test_both_panels_have_one_error_axis() -> None:
    layout = footprint_error_return([TOM], 300).to_dict()["layout"]
    assert layout["yaxis2"]["matches"] == "y"
    assert layout["yaxis"]["type"] == layout["yaxis2"]["type"] == "log"
    assert [mark["x0"] for mark in layout["shapes"]] == [0, 1]


def test_what_is_left_out_is_said() -> None:
    def notes(figure: Figure) -> str:
        return " ".join(note["text"] for note in figure.to_dict()["layout"].get("annotations", []))

    assert "2 of 6" in notes(footprint_error_return([TOM, MLE], 300))
    assert notes(footprint_error_return([TOM.at(TOM.telling)], 300)) == ""
    figure = footprint_error_return([TOM.at(np.zeros(2 * FITS, np.int64))], 300)
    assert len(points(figure, "tom")[1]["x"]) == FITS
    assert "1,500 of 3,000" in notes(figure)


def test_names_from_files_are_words() -> None:
    named = replace(TOM, run_id="<img src=x>", group="<b>x")
    assert "<img" not in str(points(footprint_error_return([named], 300), "tom"))
