"""Labels at the ends of lines, and figures drawn anew for a paper."""

import io
import json
import re
from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np
import pandas as pd
import plotly.graph_objects as go
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from matplotlib.markers import MarkerStyle
from PIL import Image
from studio_pages import in_browser, saved

from app import theme
from app.figures.curves import (
    GAP,
    Axes,
    group_curves,
    label_ends,
    opens_until,
    spread_apart,
    styles_of,
)
from app.figures.exams import footprint_error_return
from app.figures.paper import KINDS, SYMBOLS, WIDTHS, paper_figure
from app.figures.statistics import improvement
from app.figures.weights import median_profiles, over_fits
from app.figures.why import waterfall
from tom.analysis.curves import Curve, Group, aggregate
from tom.analysis.exams import Exams
from tom.analysis.why import Sum
from tom.record.decode import Profiles

STEPS = np.arange(0, 50_000, 1000)


def group(learner: str, end: float, runs: int = 3, lowest: float = 0.0) -> Group:
    return aggregate(
        [
            Curve(f"{learner}-{seed}", "hopper", learner, "paper", seed, STEPS,
                  np.linspace(lowest, end + seed, len(STEPS)))
            for seed in range(runs)
        ]
    )  # fmt: skip


def labelled(groups: list[Group], axes: Axes = Axes()) -> go.Figure:  # noqa: B008 (it is frozen)
    looks = styles_of((one.env, one.kind) for one in groups)
    figure = group_curves(groups, "eval/return", 300, singles=False, axes=axes, styles=looks)
    return label_ends(figure, groups, looks, axes)


def labels(figure: go.Figure) -> list[dict[str, Any]]:
    notes = figure.to_dict()["layout"]["annotations"]
    return [one for one in notes if one["xref"] == "paper" and one["yref"] == "y"]


@settings(deadline=None)
@given(st.lists(st.floats(0, 300), min_size=1, max_size=8), st.floats(1, 20))
def test_places_are_spread_apart_and_keep_their_order(places: list[float], gap: float) -> None:
    before = np.array(places)
    after = spread_apart(before, gap)
    assert (np.diff(after[np.argsort(before, kind="stable")]) > 0.95 * gap).all()
    apart = np.diff(np.sort(before))
    if not len(apart) or apart.min() >= gap:
        assert after == pytest.approx(before)


def test_long_names_leave_the_lines_their_room_and_are_told_apart() -> None:
    variants = [f"model.hidden {units}, rollout.uniform_share 0.5, tom.flow {flow}"
                for units in (8, 200) for flow in ("restart", "discounted")]  # fmt: skip
    figure = labelled([replace(group("tom", 90), variant=words) for words in variants])
    drawn = [one["text"] for one in labels(figure)]
    assert len(set(drawn)) == len(variants)
    assert figure.layout.margin.r < 220  # of a panel that is 416 pixels wide


def test_one_longer_run_leaves_the_others_the_width() -> None:
    steps = np.arange(0, 150_000, 1000)
    long = Curve("long", "hopper", "tom", "paper", 9, steps, steps / 300)
    several, alone = group("tom", 90), aggregate([replace(long, learner="mle")])
    late = aggregate([replace(long, learner="pmac", step=steps[90:], value=steps[90:] / 600)])
    for groups in ([aggregate([*several.curves, long])], [several, alone, late]):
        figure = labelled(groups)
        assert figure.to_dict()["layout"]["xaxis"]["range"] == [0, STEPS[-1]]
        assert max(one["y"] for one in labels(figure)) < 200  # where the lines leave the figure
    assert opens_until([alone]) == opens_until([aggregate([several.curves[0], long])]) == steps[-1]
    live = replace(long, growing=True)
    assert opens_until([aggregate([*several.curves, live])]) == steps[-1]


def test_a_line_is_named_at_its_end_with_its_runs_in_its_colour() -> None:
    groups = [group("tom", 90), replace(group("mle", 10, runs=1), variant="<img src=x>")]
    figure = labelled(groups)
    assert figure.to_dict()["layout"]["showlegend"] is False
    names = "TOM (3)", "MLE, &lt;img src=x&gt; (1)"
    for label, one, words in zip(labels(figure), groups, names, strict=True):
        assert label["text"].endswith(words)
        assert styles_of([(one.env, one.kind)])[one.kind].colour in label["text"]
        assert label["y"] == pytest.approx(one.mean[-1])  # far from the other


@pytest.mark.parametrize("log", [False, True])
def test_labels_of_lines_that_end_together_do_not_overlap(log: bool) -> None:
    groups = [group(name, 90.0 + i, lowest=1) for i, name in enumerate(("tom", "mle", "pmac"))]
    at = [label["y"] for label in labels(labelled(groups, Axes(log_y=log)))]
    ends = np.array([1.0, max(float(one.high.max()) for one in groups)])
    pixels = np.array(at) * (300 - 60) / np.ptp(np.log10(ends) if log else ends)
    assert min(abs(a - b) for a, b in combinations(pixels, 2)) > 0.95 * GAP


# For a paper


def message(groups: list[Group], **changed: Any) -> dict[str, Any]:
    """What `plot.js` sends of a figure of curves with labels at the ends of its lines."""
    figure = labelled(groups).to_dict()
    made: list[Any] = list(labelled(groups).data)
    traces = [
        {
            "axes": "xy", "type": "scatter", "name": trace.name, "x": [*map(float, trace.x)],
            "y": [None if np.isnan(y) else float(y) for y in trace.y], "z": None,
            "mode": trace.mode, "opacity": trace.opacity or 1,
            "colour": trace.line.color or "#444444", "width": trace.line.width,
            "dash": trace.line.dash or "solid", "shape": "linear", "symbol": "circle", "size": 6,
            "fill": trace.fillcolor,
            "bars": None, "marks": None, "showlegend": False, "colorscale": None, "zmin": None,
            "zmax": None, "ticks": None,
        }
        for trace in made
    ]  # fmt: skip
    axis = {"type": "linear", "domain": [0, 1], "tickvals": None, "ticktext": None}
    axes = {
        "x": axis | {"range": [0, 50_000], "title": "env steps"},
        "y": axis | {"range": [0, 100], "title": "Return"},
    }
    notes = [
        {name: one[name] for name in ("text", "x", "y", "xref", "yref")}
        for one in figure["layout"]["annotations"]
    ]
    shape = {"x0": 0, "x1": 1, "y0": 20, "y1": 20, "dash": "dash"}
    whole = {"traces": traces, "axes": {"xy": axes}, "annotations": notes, "shapes": [shape],
             "legend": False, "ratio": 0.6}  # fmt: skip
    return json.loads(json.dumps(whole | changed))


CURVE, RETURNS = Curve("r", "hopper", "tom", "paper", 0, STEPS[1:2], np.ones(1)), {"a": 7, "b": 9}
GROUPS = [group("tom", 90), group("mle", 88), group("pmac", 20, runs=1)]


@pytest.mark.parametrize("width", WIDTHS)
def test_a_paper_s_figure_has_the_width_of_its_columns_and_the_page_s_words(width: str) -> None:
    files = {kind: paper_figure(message(GROUPS), width, kind) for kind in KINDS}
    inches, svg = WIDTHS[width], files["svg"].decode()
    (box,) = re.findall(rb"/MediaBox \[ ?0 0 ([\d.]+) ", files["pdf"])
    (points,) = re.findall(r'<svg[^>]* width="([\d.]+)pt"', svg, re.DOTALL)
    assert float(box) == float(points) == pytest.approx(72 * inches)
    assert Image.open(io.BytesIO(files["png"])).width == round(600 * inches)
    words = re.findall(r"<text[^>]*>([^<]+)</text>", svg)
    assert {"TOM (3)", "MLE (3)", "env steps", "Return", "20k"} <= {*words}
    for look in styles_of((one.env, one.kind) for one in GROUPS).values():
        assert look.colour in svg.lower()


def test_every_mark_of_a_learner_is_seen_without_an_edge() -> None:
    assert {*theme.SYMBOLS, theme.learner_symbol("no learner")} <= set(SYMBOLS)
    assert all(MarkerStyle(mark).is_filled() for mark in SYMBOLS.values())


def test_a_legend_a_heatmap_bars_and_a_log_axis_are_drawn() -> None:
    shown = message(GROUPS, legend=True, annotations=[])
    for trace in shown["traces"]:
        trace["showlegend"] = trace["fill"] is None
    assert "TOM (n = 3)" in paper_figure(shown, "one", "svg").decode()
    shown["axes"]["xy"]["y"] |= {"type": "log", "range": [0, 2]}
    assert paper_figure(shown, "two", "pdf").startswith(b"%PDF")
    first = shown["traces"][0]
    first |= {"type": "bar", "x": [1, 2, 3], "y": [1, 2, 1], "colour": "rgba(18, 171, 52, 0.8)"}
    scale = [[0, "#ffffff"], [0.5, "rgb(243, 241, 237)"], [1, "#8c2304"]]
    heat = {"type": "heatmap", "x": [1, 2], "y": [0.5, 1.5], "z": [[1, None], [3, 4]],
            "colorscale": scale, "zmin": 0, "zmax": 4,
            "ticks": {"tickvals": [0, 4], "ticktext": ["none", "much"]}}  # fmt: skip
    shown |= {"traces": [first, first | heat], "shapes": []}
    shown["axes"]["xy"]["y"] |= {"type": "linear", "range": [0, 2]}
    drawn = paper_figure(shown, "two", "svg").decode()
    assert "#12ab34" in drawn
    assert "much" in drawn


# As CSV


@in_browser
def test_a_name_is_saved_as_it_is_read() -> None:
    pair = {"first": "A", "second": "B", "p": 0.1, "p corrected": 0.1}
    pairs = pd.DataFrame([pair | {"probability": 0.8, "low": 0.5, "high": 0.9}])
    figure = improvement(pairs, ["#12ab34"], 200, "")
    assert str(saved(figure)["line"][0]).startswith("A > B")
    shown = message(GROUPS, annotations=[])
    shown["axes"]["xy"]["y"] |= {
        "tickvals": [0], "ticktext": figure.to_dict()["layout"]["yaxis"]["ticktext"],
    }  # fmt: skip
    assert ">A &gt; B<" in paper_figure(shown, "one", "svg").decode()


@in_browser
def test_each_panel_s_numbers_are_saved_under_its_own_axes() -> None:
    one = np.ones(1)
    exams = Exams("r", "tom", 0, "g", np.array([100]), one, one, 0.5 * one, 0.1 * one, 20 * one)
    rows = saved(footprint_error_return([exams], 300)).dropna(subset="x").set_index("x is")["x"]
    assert rows.filter(like="footprint").tolist() == [0.5]
    assert rows.filter(like="return").tolist() == [20]
    at, bins = np.array([100]), np.ones((1, 2))
    profiles = Profiles(at, bins, at, one, one, at)
    parts = [
        (name, replace(CURVE, value=float(value) * one), profiles)
        for name, value in RETURNS.items()
    ]
    rows = saved(over_fits(parts, "light", 300)).set_index("y is").loc["return"]
    assert dict(zip(rows["line"], rows["y"], strict=True)) == {"a return": 7, "b return": 9}


@in_browser
def test_no_name_of_a_saved_table_is_a_formula() -> None:
    formula = '=HYPERLINK("http://evil.example")'
    rows = saved(labelled([group(formula, 90), replace(group("tom", 9), variant="-5")]))
    assert set(rows["group"].dropna()) == {f"'{formula}", "TOM, -5"}
    assert rows["line"].str.match(r"[=+\-@]").sum() == 0
    assert min(rows["Return"].tolist()) == 0


@in_browser
def test_weights_below_the_axis_are_saved_as_they_are() -> None:
    rows = saved(median_profiles({"tom": np.array([[0.0, 0.002, 3.0]])}, 0, 300))
    assert rows["mean weight"].tolist() == [0, 0.002, 3]


def test_columns_have_their_names_and_one_scale_in_a_paper_s_figure() -> None:
    shown = message(GROUPS, annotations=[])
    heat = {"type": "heatmap", "x": [1, 2], "y": [0.5, 1.5], "z": [[1, 2], [3, 4]], "zmin": 0,
            "zmax": 4, "colorscale": [[0, "#ffffff"], [1, "#8c2304"]]}  # fmt: skip
    ticks = {"tickvals": [0, 4], "ticktext": ["none", "much"]}
    left, right = shown["axes"]["xy"], json.loads(json.dumps(shown["axes"]["xy"]))
    left["x"]["domain"], right["x"]["domain"] = [0, 0.49], [0.51, 1]
    shown["traces"] = [
        shown["traces"][0] | heat | {"axes": axes, "ticks": of}
        for axes, of in (("xy", None), ("x2y2", ticks))
    ]
    shown["axes"] = {"xy": left, "x2y2": right}
    at_top = {"xref": "paper", "yref": "paper", "y": 0.9999999}
    shown["annotations"] = [
        at_top | {"text": text, "x": x} for text, x in (("TOM", 0.2), ("MLE", 0.8))
    ]
    words = re.findall(r"<text[^>]*>([^<]+)</text>", paper_figure(shown, "two", "svg").decode())
    assert sorted(w for w in words if w in ("TOM", "MLE", "much")) == ["MLE", "TOM", "much"]
    assert words.count("100") == 1


@in_browser
def test_a_weight_s_sum_is_saved() -> None:
    rows = saved(waterfall(Sum(1.0, 0.5, 0.0, 0.7, 0.0, 1.8, 0.9, 2.0), "tom", 300))
    assert rows["x"].tolist() == ["r", "'+ g E Q(s', a')", "'- Q(s, a)", "sum", "weight"]
    assert rows["y"].tolist() == pytest.approx([1, 0.5, -0.7, 0.8, 2])
    shown, sizes = message(GROUPS, annotations=[]), rows["y"].tolist()
    of = {"type": "waterfall", "x": [*range(5)], "y": sizes,
          "measure": ["relative"] * 3 + ["total", "absolute"],
          "tints": ["#111111", "#222222", "#333333"]}  # fmt: skip
    shown["traces"] = [shown["traces"][0] | of]
    shown["axes"]["xy"]["y"]["range"] = [0, 2]
    drawn = paper_figure(shown, "one", "svg").decode()
    assert [drawn.count(tint) for tint in of["tints"]] == [2, 1, 2]
