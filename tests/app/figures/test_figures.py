"""The numbers in the figures are the numbers in the run folders."""

from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import plotly.graph_objects as go
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from studio_runs import PENDULUM_TOM, info

from app.data import readers
from app.figures.base import decimate, relative_scale
from app.figures.curves import CORE, POINTS, Axes, group_curves, single_run_group
from app.figures.exams import FITS, errors_by_age, footprint_error_return
from app.figures.replay import observation_windows
from app.figures.statistics import improvement
from app.figures.weights import (
    MAP_COLUMNS,
    median_profiles,
    over_fits,
    weight_profile,
)
from app.theme import learner_colour, learner_symbol
from tom.analysis.curves import GRID, Curve, aggregate
from tom.analysis.exams import Exams
from tom.record.decode import Profiles

WINS = pd.DataFrame(
    [
        {"first": first, "second": "MLE", "probability": 0.9, "low": 0.7, "high": 1.0, "p": p,
         "p corrected": corrected}
        for first, p, corrected in (("TOM", 0.03, 0.06), ("PMAC", 0.4, 0.4))
    ]
)  # fmt: skip


@pytest.fixture
def profiles(store: Path) -> Profiles:
    return readers.profiles(info(store, PENDULUM_TOM))


def traces(figure: go.Figure) -> list[Any]:
    """Without the insides of hollow lines."""
    return [trace for trace in drawn(figure) if trace.name != CORE]


def drawn(figure: go.Figure) -> list[Any]:
    return list(figure.data)


def notes(figure: go.Figure) -> list[str]:
    return [note["text"] for note in figure.to_dict()["layout"].get("annotations", [])]


def long_curve(points: int, seed: int = 0) -> Curve:
    value = np.random.default_rng(seed).normal(size=points)
    return Curve(f"run-{seed}", "hopper", "tom", "paper", seed, np.arange(points), value)


def test_long_curves_and_many_fits_are_thinned_and_say_so(profiles: Profiles) -> None:
    many = Profiles(*(np.resize(part, (1000, *part.shape[1:])) for part in vars(profiles).values()))
    many = replace(many, env_step=np.arange(1000))
    for points, fits in ((100_000, many), (100, profiles)):
        curves = [long_curve(points, seed) for seed in (0, 1)]
        for figure, limit, words in (
            (group_curves([aggregate(curves)], "x", 300, singles=True), 2 * GRID,
             [str(GRID), str(POINTS)]),
            (over_fits([("a", curves[0], fits)], "light", 400), POINTS,
             [str(POINTS), f"{MAP_COLUMNS} of 1000"]),
        ):  # fmt: skip
            assert max(len(line.x) for line in traces(figure)) <= limit
            said = " ".join(notes(figure))
            assert [word in said for word in words] == [points > 100] * len(words)


def test_a_group_has_single_runs_a_band_and_a_mean() -> None:
    group = aggregate([long_curve(50, seed) for seed in range(3)])
    figure = group_curves([group], "eval/return", 300, singles=True)
    *faint, band, mean = traces(figure)
    assert [line.meta for line in faint] == ["run-0", "run-1", "run-2"]
    assert max(line.opacity for line in faint) < 0.5
    assert mean.name == "TOM (n = 3)"
    assert mean.y.tolist() == group.mean.tolist()
    assert band.y.tolist() == [*group.high, *group.low[::-1]]
    assert len(traces(group_curves([group], "x", 300, singles=False))) == 2


def test_a_log_axis_says_what_it_leaves_out_and_keeps_bands_above_zero() -> None:
    step = np.arange(3)
    values = ([-1.0, 1.0, 4.0], [-3.0, 2.0, 8.0], [-2.0, -5.0, 9.0])
    curves = [
        Curve(str(i), "ant", "tom", "paper", i, step, np.array(v)) for i, v in enumerate(values)
    ]
    group = aggregate(curves)
    figure = group_curves([group], "x", 300, singles=False, axes=Axes(log_y=True))
    band, line = traces(figure)
    assert line.y.tolist() == pytest.approx(group.mean.tolist())
    assert band.y.min() == 2  # the smallest positive value of the line and of the band
    assert notes(figure) == ["2 of 3 values at or below zero: not on a log axis"]
    single = [single_run_group(curve, curve.run_id) for curve in curves]
    figure = group_curves(single, "x", 300, singles=False, axes=Axes(log_x=True, log_y=True))
    assert notes(figure) == ["4 of 9 values at or below zero: not on a log axis"]
    assert not notes(group_curves(single, "x", 300, singles=False))


def test_profiles_on_a_log_axis_end_at_a_hundredth_of_uniform() -> None:
    values = np.array([[0.0, 0.0, 2.0, 1.0], [0.0, 1.0, 4.0, 1.0]])
    band, line = traces(median_profiles({"tom": values}, 0, 300))
    assert band.y.tolist() == [0.01, 1, 4, 1, 1, 2, 0.01, 0.01]
    assert line.y.tolist() == [0.01, 0.5, 3, 1]
    assert band.customdata.tolist() == [0, 1, 4, 1, 1, 2, 0, 0]  # the weights themselves
    assert line.customdata.tolist() == [0, 0.5, 3, 1]


def test_where_runs_are_missing_the_mean_is_dotted() -> None:
    group = aggregate([long_curve(10, 0), long_curve(20, 1)])
    solid, dotted = traces(group_curves([group], "x", 300, singles=False))[1:]
    assert solid.x.tolist() == list(range(10))
    assert dotted.line.dash == "dot"
    shown = dotted.x[np.isfinite(dotted.y)]
    assert shown.tolist() == list(range(9, 20))
    assert dotted.customdata[-1] == 1


def test_a_run_with_one_fit_has_a_column_that_can_be_seen_and_clicked(profiles: Profiles) -> None:
    one = Profiles(*(getattr(profiles, field.name)[:1] for field in fields(Profiles)))
    heat = traces(over_fits([("", long_curve(9), one)], "light", 300))[0]
    step, (left, right) = int(one.env_step[0]), heat.x
    assert (left + right) / 2 == step
    assert right - left >= max(0.04 * step, 1)
    assert np.asarray(heat.z).shape == (one.bins.shape[1], 1)


@pytest.mark.parametrize(
    ("weight", "ends"),
    [
        ([0.5, 1, 2, np.nan], ("1/2", "2")),
        ([1.0] * 99 + [16.0], ("1/2", "≥ 2")),
        ([0.25] * 5 + [4.0] * 94 + [0], ("≤ 1/4", "4")),
        ([0.01, 50.0], ("≤ 1/16", "≥ 16")),
    ],
)
def test_a_colour_bar_says_where_its_ends_hold_more(
    weight: list[float], ends: tuple[str, str]
) -> None:
    words = relative_scale(np.array(weight), "light")["colorbar"]["ticktext"]
    assert (words[0], words[-1]) == ends


def zooms(run_id: str, profiles: Profiles) -> list[str]:
    """What each figure of a run's data keeps its zoom for."""
    bins, last = profiles.bins, len(profiles.env_step) - 1
    curve = replace(long_curve(len(bins)), run_id=run_id)
    drawn = [
        weight_profile(bins[last], "tom", 300, keep=run_id),
        over_fits([("a", curve, profiles)], "light", 400),
        median_profiles({"tom": bins}, 0, 300, keep=run_id),
        errors_by_age([("a", "tom", bins[last])], 5, 300, keep=run_id),
        observation_windows(bins[None], bins[None], ["a"], 100, keep=run_id),
        improvement(WINS.head(1), ["red"], 200, run_id),
    ]
    return [figure.to_dict()["layout"]["uirevision"] for figure in drawn]


def test_a_p_among_several_is_shown_with_its_correction() -> None:
    said = [
        [words.partition("<br>")[2] for words in figure.layout.yaxis.ticktext]
        for shown in (WINS, WINS.head(1))
        for figure in [improvement(shown, ["red"] * len(shown), 200, "a")]
    ]
    assert [list(words)[::-1] for words in said] == [
        ["p 0.03, corrected 0.06", "p 0.4, corrected 0.4"],
        ["p 0.03"],
    ]


def test_a_zoom_lasts_while_its_run_grows_and_is_none_of_another_run(profiles: Profiles) -> None:
    younger = Profiles(*(part[:1] for part in vars(profiles).values()))
    assert len(younger.env_step) < len(profiles.env_step)
    assert zooms("a", younger) == zooms("a", profiles)
    assert not set(zooms("a", profiles)) & set(zooms("b", profiles))


def test_a_zoom_on_the_curves_of_a_task_is_none_of_another() -> None:
    group = aggregate([long_curve(10, 0)])
    kept = {
        group_curves([replace(group, env=env)], "x", 300, singles=False).to_dict()["layout"][
            "uirevision"
        ]
        for env in ("ant", "hopper")
    }
    assert len(kept) == 2


@settings(deadline=None)
@given(st.integers(10, 3000), st.integers(4, 200))
def test_thinning_keeps_the_extremes(count: int, limit: int) -> None:
    value = np.random.default_rng(count).normal(size=count)
    step, kept, cut = decimate(np.arange(count), value, limit)
    assert cut == (count > limit)
    assert len(step) <= limit or not cut
    assert kept.max() == value.max()
    assert kept.min() == value.min()
    assert np.array_equal(value[step], kept)
    assert (np.diff(step) > 0).all()


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


def points(figure: go.Figure, learner: str) -> list[Any]:
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
    keys = [one.marker.color for one in drawn(figure) if one.meta is None]
    assert keys == [learner_colour("tom"), learner_colour("mle")]
    assert list(points(figure, "mle")[0]["x"]) == [1, 1]
    layout = figure.to_dict()["layout"]  # one error axis
    assert layout["yaxis2"]["matches"] == "y"
    assert layout["yaxis"]["type"] == layout["yaxis2"]["type"] == "log"


def test_fits_that_are_left_out_are_said_and_names_from_files_are_words() -> None:
    (said,) = notes(footprint_error_return([TOM, MLE], 300))
    assert "2 of 6" in said
    assert notes(footprint_error_return([TOM.subset(TOM.informative)], 300)) == []
    figure = footprint_error_return([TOM.subset(np.zeros(2 * FITS, np.int64))], 300)
    assert len(points(figure, "tom")[1]["x"]) == FITS
    assert "1,500 of 3,000" in notes(figure)[0]
    named = replace(TOM, run_id="<img src=x>", group="<b>x")
    assert "<img" not in str(points(footprint_error_return([named], 300), "tom"))
