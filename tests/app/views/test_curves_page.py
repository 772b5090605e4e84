"""Curves on real recorded runs: its numbers are the runs' numbers."""

import json
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import numpy as np
import pandas as pd
import plotly.graph_objects as go
import pytest
from common import change
from hypothesis import given
from hypothesis import strategies as hypothesis
from scipy.stats import mannwhitneyu
from streamlit.testing.v1 import AppTest
from studio_pages import PAGE, TIMEOUT_S, array, draw, figures, parts, plain, recorded, trace
from studio_runs import PENDULUM_TOM, ROAD_TOM, info, set_status, trains_elsewhere

from app.data.tables import default_level
from app.figures import statistics
from app.figures.curves import Axes, Style
from app.figures.statistics import Profile
from app.links import Links
from app.parts import shortlinks
from app.parts.plot import Point, View
from app.parts.scope import Scope
from app.servers.pages import routes
from app.theme import learner_colour
from app.views import curves as page
from app.views.curves import measure, numbers
from app.views.curves.measure import favourites_first
from tom.analysis.curves import Curve, Group
from tom.analysis.scores import BEST, FINAL
from tom.plugins import CHARTS
from tom.record import layout, manage
from tom.record.reader import RunReader
from tom.record.store import Store

pytestmark = pytest.mark.usefixtures("studio")
PENDULUM = "inverted-pendulum"
PENDULUM_MLE = "pendulum-mle-0"
SEEDS = (PENDULUM_TOM, "pendulum-tom-1")
BOTH, ALONE = "TOM (n = 2)", "TOM (1 seed, no band)"
LOOKS = tuple(Style(name.upper(), learner_colour(name), "solid", "o") for name in ("tom", "mle"))


def curves(part: str = "Curves", task: str = PENDULUM, **query: str | list[str]) -> AppTest:
    return draw("curves", part=part, task=task, **query)


def click(app: AppTest, key: str) -> None:
    app.button(key=key).click().run()
    assert not app.exception


def first(app: AppTest) -> dict:
    return figures(app)[0]


def by_learner(app: AppTest):
    """The table below the panels, of the first metric."""
    return app.dataframe[0].value.set_index("learner")


# Panels


def test_a_group_has_the_mean_over_its_seeds(store: Path) -> None:
    app = curves()
    drawn = [part["label"].split()[0] for part in parts(app, "tom_plot")]
    assert drawn == list(measure.FIRST[:4])
    assert {part["linked"] for part in parts(app, "tom_plot")} == {"curves"}
    values = [recorded(store, run_id)[1] for run_id in SEEDS]
    assert array(trace(first(app), name=BOTH)["y"]) == pytest.approx(np.mean(values, axis=0))
    assert trace(first(app), name="MLE (1 seed, no band)")
    row = by_learner(app).loc["TOM"]
    assert row["n"] == 2
    assert row["final"] == pytest.approx(np.mean([v[-1] for v in values]))
    assert row["best"] == pytest.approx(np.mean([max(v) for v in values]))
    every = curves(task="every task", panel="eval/return")
    assert len(figures(every)) == 2
    assert (
        every.dataframe[0].value["environment"].tolist() == [PENDULUM] * 2 + ["road-and-rocks"] * 2
    )


def test_exams_of_seeds_are_put_together_at_the_steps_of_their_fits(store: Path) -> None:
    lines = (store / PENDULUM_TOM / layout.METRICS).read_text().splitlines()
    told = [json.loads(line)["env_step"] for line in lines]
    assert told != sorted(told)  # an exam is told under the step of its fit
    app = curves(panel="exam/error")
    found = [recorded(store, run_id, "exam/error") for run_id in SEEDS]
    line = trace(first(app), name=BOTH)
    assert found[0][0] == found[1][0] == array(line["x"]).tolist()
    assert array(line["y"]) == pytest.approx(np.mean([values for _, values in found], 0))
    highest = np.mean([max(values) for _, values in found])
    assert by_learner(app).loc["TOM", "highest"] == pytest.approx(highest)
    assert "best" not in app.dataframe[0].value.columns
    names = ["critic/q", "exam/footprint", "env_step", "exam/error", "exam/nll", "actor/loss"]
    first_ones = ["exam/error", "exam/footprint"]
    assert favourites_first(names) == [*first_ones, "actor/loss", "critic/q", "exam/nll"]


def test_median_with_the_band_of_a_deviation(store: Path) -> None:
    app = curves(statistic="median", band="standard deviation", logy="true")
    values = np.array([recorded(store, run_id)[1] for run_id in SEEDS])
    line, band = (trace(first(app), name=name) for name in (BOTH, "band"))
    assert array(line["y"]) == pytest.approx(np.median(values, axis=0))
    assert array(band["y"])[-1] == pytest.approx((values.mean(0) - values.std(0, ddof=1))[0])
    assert first(app)["layout"]["yaxis"]["type"] == "log"


def test_any_metric_over_wall_time_and_shares_of_the_run(store: Path) -> None:
    app = curves(task="road-and-rocks", panel="eval/return_max")
    line = trace(first(app), name=ALONE)
    assert array(line["y"]).tolist() == recorded(store, ROAD_TOM, "eval/return_max")[1]
    steps, ess = recorded(store, PENDULUM_TOM, "weights/ess")
    at, minutes = recorded(store, PENDULUM_TOM, "time/wall_s")
    for x, expected in (
        (measure.SHARE, np.array(steps) / 400),
        (measure.WALL, np.interp(steps, at, minutes) / 60),
    ):
        app = curves(find=PENDULUM_TOM, panel="weights/ess", x=x)
        line = first(app)["data"][-1]
        assert array(line["x"]) == pytest.approx(expected)
        assert array(line["y"]) == pytest.approx(ess)
        assert not parts(app, "tom_timeline")  # its steps are of no such axis


def test_panels_that_another_task_lacks_are_there_on_return() -> None:
    app = curves(panel=["planner/return", "eval/return"], task="road-and-rocks")
    for task in (PENDULUM, "road-and-rocks"):
        app.selectbox(key="task").select(task).run()
    assert app.session_state["panel"] == ["planner/return", "eval/return"]
    assert len(figures(app)) == 2


@pytest.mark.parametrize("part", ["Curves", "Statistics", "Settings", "Runs"])
def test_without_any_run_to_show_the_page_stays_whole(part: str) -> None:
    app = curves(part, hide=["TOM", "MLE"])
    assert not figures(app)
    assert len(app.dataframe) == (part == "Runs")
    app = curves(part, find="no such run")
    assert not figures(app)
    assert app.info


def test_any_setting_makes_groups(store: Path) -> None:
    app = curves(group="seed")
    both, one = (
        trace(first(app), name=f"seed {seed} ({n})")
        for seed, n in ((0, "n = 2"), (1, "1 seed, no band"))
    )
    assert both["meta"] == [PENDULUM_MLE, SEEDS[0]]
    values = np.array([recorded(store, run_id)[1] for run_id in both["meta"]])
    assert array(both["y"]) == pytest.approx(values.mean(0))
    assert both["line"]["color"] != one["line"]["color"]
    assert app.dataframe[0].value["settings"].tolist() == ["seed 0", "seed 1"]
    app = curves("Statistics", group="seed")
    assert app.dataframe[0].value["group"].tolist() == ["seed 0", "seed 1"]
    assert trace(first(app), name="seed 0")["line"]["color"] == both["line"]["color"]


def test_a_click_on_a_line_chooses_the_run_nearest_to_it_and_its_step(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    made = [
        Curve(run_id, "e", "tom", "p", i, np.array([0.0, last]), np.array([0.0, value]))
        for i, (run_id, last, value) in enumerate(
            (("low", 100.0, 10.0), ("high", 100.0, 20.0), ("ended", 40.0, 9.0))
        )
    ]

    def chosen(y: float, meta: str | list[str], x: float = 50.0) -> dict:
        state: dict = {}
        with monkeypatch.context() as patch:
            patch.setattr(page.st, "session_state", state)
            page._clicked(made, Point(x, y, 0, meta))
        return state

    group = ["low", "high", "ended"]
    high = chosen(9.0, group)
    assert (high["run"], high["step"]) == (["high"], 50)
    assert chosen(6.0, group)["run"] == ["low"]
    assert chosen(9.0, "low")["run"] == ["low"]
    assert "run" not in chosen(9.0, ["ended"])
    assert trace(first(curves()), name=BOTH)["meta"] == list(SEEDS)


def test_a_chart_of_a_plugin_that_raises_takes_nothing_else_with_it(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    before = len(figures(curves()))

    def broken(*_: object) -> go.Figure:
        raise ZeroDivisionError("of a plug-in")

    monkeypatch.setitem(CHARTS, "exam/error", broken)
    app = AppTest.from_string(PAGE.format(view="curves"), default_timeout=TIMEOUT_S)
    app.query_params["task"] = PENDULUM
    app.run()
    assert len(app.exception) == 1
    assert len(figures(app)) == before - 1


# Addresses


@given(hypothesis.floats(-1e9, 1e9), hypothesis.floats(1e-6, 1e6), hypothesis.sampled_from("xy"))
def test_a_zoom_is_read_as_it_was_written(low: float, width: float, axis: str) -> None:
    name = "" if axis == "x" else "mine/a~b"
    low, high = (float(f"{end:.5g}") for end in (low, low + width))
    seen = {name: (low, high)} if low < high else {}
    assert measure.parse_zoom([f"{name}~{low:.5g}~{high:.5g}"]) == seen
    for nothing in ("", "ant", "ant~1~2~", "ant~2~1", "ant~nan~1", "~~~~", "ant~0~inf"):
        assert measure.parse_zoom([nothing]) == {}


def test_a_zoom_is_in_the_address_and_its_x_axis_is_that_of_all_panels() -> None:
    words = ["~0~300", "eval/return~-1~20"]
    app = curves(zoom=words)
    views = {part["label"].split()[0]: part["view"] for part in parts(app, "tom_plot")}
    assert views["eval/return"] == {"x": [0, 300], "y": [-1, 20]}
    assert views["exam/error"] == {"x": [0, 300], "y": None}
    assert app.query_params["zoom"] == words
    app.selectbox(key="x").select(measure.SHARE).run()
    assert "zoom" not in app.query_params
    app = curves(zoom=words)
    app.selectbox(key="task").select("road-and-rocks").run()
    assert "zoom" not in app.query_params


def test_a_zoom_out_of_one_panel_leaves_the_heights_of_the_others(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    state: dict = {}
    monkeypatch.setattr(measure.st, "session_state", state)
    seen = {"": (0.0, 9.0), "a": (1.0, 2.0), "b": (3.0, 4.0)}
    measure.set_zoom(seen, "a", View())
    assert state[measure.ZOOM] == {"b": (3.0, 4.0)}
    measure.set_zoom(seen, "b", View((5.0, 6.0), None))
    assert state[measure.ZOOM] == {"": (5.0, 6.0), "a": (1.0, 2.0)}


def test_the_timeline_is_of_the_chosen_run(store: Path) -> None:
    run = RunReader(store / SEEDS[1])
    (timeline,) = parts(curves(run=SEEDS[1], step="250"), "tom_timeline")
    fits, evaluations = run.profiles().env_step.tolist(), run.evaluation_steps()
    assert timeline["given"]["fits"] == fits
    assert timeline["given"]["stops"] == sorted({*fits, *evaluations})
    assert timeline["step"] == max(stop for stop in timeline["given"]["stops"] if stop <= 250)


def test_a_killed_training_no_longer_decides_where_the_charts_of_others_open(own: Path) -> None:
    short, other = (own / run_id for run_id in SEEDS)
    change(short / layout.CONFIG, preset="paper")
    change(other / layout.CONFIG, preset="mended")
    (short / layout.METRICS_TABLE).unlink()
    for file in (short / layout.METRICS, short / layout.PROFILES):
        rows = file.read_text().splitlines(keepends=True)
        file.write_text("".join(row for row in rows if json.loads(row)["env_step"] <= 200))
    trains_elsewhere(short)

    def opened() -> list[list[float] | None]:
        """The part of the x axis that each page opens at; None: all of it."""
        pages = (
            curves(hide="MLE", panel="weights/ess"),
            draw("answer", task=PENDULUM, one="TOM paper", other="TOM mended"),
        )
        return [first(shown)["layout"]["xaxis"].get("range") for shown in pages]

    assert opened() == [[200, 200], [200, 200]]
    set_status(short, heartbeat=0.0)
    assert opened() == [None, None]


def test_panels_that_are_drawn_again_alone_know_which_training_goes_on(
    own: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    trains_elsewhere(own / PENDULUM_TOM)
    run = info(own, PENDULUM_TOM)
    before = run.with_status(replace(run.status, heartbeat=0.0))  # of when the page was drawn
    going_on: list[bool] = []

    def grouped(runs: Sequence[RunReader], *_: object) -> tuple[list[Curve], list[Group]]:
        going_on.extend(run.status.alive for run in runs)
        return [], []

    monkeypatch.setattr(measure, "grouped", grouped)
    monkeypatch.setattr(measure, "zoom", lambda _: {})
    drawn = SimpleNamespace(runs=[before], shown=[before], kinds={})
    how = measure.Measure(Axes(), "mean", "bootstrap", 1, singles=False)
    page._panels(cast(Scope, drawn), ["eval/return"], how)
    assert going_on == [True]


def test_a_short_link_leads_to_the_same_view(own: Path) -> None:
    code = shortlinks.save(own, "curves", "task=hopper&x=a%2Fb")
    assert code == shortlinks.save(own, "curves", "task=hopper&x=a%2Fb")
    assert shortlinks.target(own, code) == "/curves?task=hopper&x=a%2Fb"
    assert not Store(own).problems
    held = own / ".views" / f"{code}.json"
    held.write_text(json.dumps({"page": "/evil.example", "query": ""}))
    assert shortlinks.target(own, code) is None
    assert shortlinks.target(own, "../../etc") is None
    assert any(getattr(route, "path", "") == "/v/{code}" for route in routes(Links(store=str(own))))
    shutil.rmtree(own / ".views")
    (own / ".views").write_text("in the way")
    app = curves()
    click(app, "short link")
    assert app.error


# Statistics


def test_statistics_are_those_of_the_scores(store: Path) -> None:
    app = curves("Statistics")
    profile, improvement = figures(app)[:2]
    tom = np.array([recorded(store, run_id)[1][-1] for run_id in SEEDS])
    mle = recorded(store, PENDULUM_MLE)[1][-1]
    line = trace(profile, name="TOM", mode="lines")
    at, share = array(line["x"]), array(line["y"])
    assert set(tom) < set(at)
    assert share[::2] == pytest.approx([(tom > score).mean() for score in at[::2]])
    assert share[1::2] == pytest.approx([(tom >= score).mean() for score in at[1::2]])  # until then
    wins = np.mean([1.0 if mle > t else 0.5 if mle == t else 0.0 for t in tom])
    assert array(improvement["data"][0]["x"]) == pytest.approx([wins])
    exact = mannwhitneyu([mle], tom, method="exact").pvalue
    (shown,) = improvement["data"][0]["text"]
    p = shown.rpartition("p ")[2].partition(":")[0]
    assert float(p) == pytest.approx(exact, abs=0.02)
    aggregates = app.dataframe[0].value.set_index("group")
    assert aggregates.loc["TOM", "mean"].startswith(f"{tom.mean():.4g}")
    app.number_input[0].set_value(float(tom.min())).run()
    reached = app.dataframe[1].value.set_index("group")
    assert reached.loc["TOM", "reached"] == "2 of 2"
    app.selectbox(key="score").select(BEST).run()
    everything = [recorded(store, run_id)[1] for run_id in (*SEEDS, PENDULUM_MLE)]
    best = np.array([max(values) for values in everything])
    assert app.number_input[0].value == default_level(best)


def test_the_run_that_ends_first_is_named_where_it_limits_the_others(own: Path) -> None:
    assert not any("go on" in line.value for line in curves("Statistics").caption)
    for run_id in SEEDS:
        (own / run_id / layout.METRICS_TABLE).unlink()
        with (own / run_id / layout.METRICS).open("a") as file:
            file.write('{"env_step":500,"eval/return":7.0}\n')
    (said,) = [line.value for line in curves("Statistics").caption if "go on" in line.value]
    assert PENDULUM_MLE in plain(said)


def test_a_profile_has_the_same_band_beside_any_other_group(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    shown: list[Profile] = []
    monkeypatch.setattr(
        numbers, "profiles", lambda of, *rest: shown.extend(of) or statistics.profiles(of, *rest)
    )
    scores = {look: np.random.default_rng(n).normal(size=20) for n, look in enumerate(LOOKS)}
    for looks in (LOOKS, LOOKS[::-1]):
        numbers._profiles(looks, [scores[look] for look in looks], FINAL, "")
    for look in LOOKS:
        before, after = [(one.low, one.high) for one in shown if one.style == look]
        assert np.array_equal(before, after)


# Settings and runs


def test_a_run_gets_a_name_is_found_by_it_and_goes_to_the_trash_and_back(own: Path) -> None:
    app = curves("Runs")
    assert set(app.dataframe[0].value["run"]) == {*SEEDS, PENDULUM_MLE}
    app.multiselect(key="labelled").select(PENDULUM_TOM).run()
    next(field for field in app.text_input if field.label == "Name").input("the good one")
    next(button for button in app.button if button.label == "Save").click().run()
    assert RunReader(own / PENDULUM_TOM).labels.name == "the good one"
    manage.label(Store(own), PENDULUM_TOM, add=["keep"])
    found = curves("Runs", tag="keep", find="GOOD")
    assert found.dataframe[0].value["run"].tolist() == [PENDULUM_TOM]
    click(app, "trash")
    assert not (own / PENDULUM_TOM).exists()
    app.multiselect(key="restored").select(PENDULUM_TOM).run()
    next(button for button in app.button if button.label == "Bring back").click().run()
    assert (own / PENDULUM_TOM / layout.CONFIG).exists()


def test_a_tick_in_the_table_is_an_eye(monkeypatch: pytest.MonkeyPatch) -> None:
    def unticked(table: pd.DataFrame, **_: object) -> pd.DataFrame:
        return table.assign(shown=table["shown"] & (table["run"] != SEEDS[1]))

    monkeypatch.setattr(page.runs.st, "data_editor", unticked)
    app = curves("Runs")
    assert app.session_state["hide"] == [SEEDS[1]]
    assert app.query_params["hide"] == SEEDS[1]


def test_what_has_its_eye_open_is_ticked_also_where_it_is_left_out(own: Path) -> None:
    change(own / SEEDS[1] / layout.STATUS, state="stopped", env_step=1)
    app = curves("Runs", hide=[PENDULUM_MLE])
    table = app.dataframe[0].value.set_index("run")
    assert table["shown"].to_dict() == {SEEDS[0]: True, SEEDS[1]: True, PENDULUM_MLE: False}


def test_tags_of_several_runs_are_those_they_share_and_others_stay(own: Path) -> None:
    manage.label(Store(own), SEEDS[0], add=["ours", "shared", "gone"])
    manage.label(Store(own), SEEDS[1], add=["shared", "gone"])
    app = curves("Runs")
    app.multiselect(key="labelled").set_value(list(SEEDS)).run()
    tags = next(part for part in app.multiselect if part.label == "Tags of these 2 runs")
    assert sorted(tags.value) == ["gone", "shared"]
    tags.set_value(["shared", "new"])
    next(button for button in app.button if button.label == "Save").click().run()
    assert not app.exception
    held = [set(RunReader(own / run_id).labels.tags) for run_id in SEEDS]
    assert held == [{"ours", "shared", "new"}, {"shared", "new"}]
