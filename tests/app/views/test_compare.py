"""The Compare page on real recorded runs: its numbers are the runs' numbers."""

import json
import shutil
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as hypothesis
from scipy.stats import mannwhitneyu
from streamlit.testing.v1 import AppTest
from studio_pages import array, captions, draw, figures, recorded, trace
from studio_runs import PENDULUM_TOM, ROAD_TOM, altered, info, set_status

from app.data.tables import default_level
from app.figures import statistics
from app.figures.curves import Look
from app.figures.statistics import Profile
from app.links import Links
from app.parts import replay_link, shortlinks
from app.parts.plot import View
from app.servers.pages import routes
from app.theme import learner_colour
from app.views.compare import numbers, zoom
from app.views.compare.choice import matching
from app.views.compare.comparison import HIDE, switched, toggled
from app.views.compare.curves import unlike_ends
from app.views.compare.replay_beside import nearest
from tom.analysis.curves import Curve, Group, aggregate
from tom.analysis.scores import BEST, FINAL, HEIGHT, scores_of
from tom.errors import UserError
from tom.record import layout, manage
from tom.record.reader import RunReader
from tom.record.store import Store

pytestmark = pytest.mark.usefixtures("studio")
PENDULUM = "inverted-pendulum"
SEEDS = ("pendulum-tom-0", "pendulum-tom-1")
LOOKS = (
    Look("TOM", learner_colour("tom"), "solid", "circle"),
    Look("MLE", learner_colour("mle"), "solid", "circle"),
)


def click(app: AppTest, key: str) -> None:
    next(button for button in app.button if button.key == key).click().run()
    assert not app.exception


def hidden(app: AppTest) -> list[str]:
    return app.session_state[HIDE]


def hide(app: AppTest, words: list[str]) -> None:
    """As an eye or the legend does."""
    app.session_state[HIDE] = words
    app.run()
    assert not app.exception


def parts(app: AppTest, name: str) -> list[dict]:
    found = [part.proto for part in app.get("bidi_component")]
    return [json.loads(proto.json) for proto in found if proto.component_name == name]


def rows(app: AppTest) -> dict[str, bool]:
    """The groups of the list beside the figure, and whether each is hidden."""
    return {group["title"]: group["hidden"] for group in parts(app, "tom_eyes")[0]["groups"]}


def test_a_group_has_the_mean_over_its_seeds(store: Path) -> None:
    app = draw("compare")
    assert len(figures(app)) == 2  # one for each task
    values = [recorded(store, run_id)[1] for run_id in SEEDS]
    mean = trace(figures(app)[0], name="TOM (n = 2)")
    assert array(mean["y"]) == pytest.approx(np.mean(values, axis=0))
    assert trace(figures(app)[0], name="MLE (1 seed, no band)")
    table = app.dataframe[0].value
    row = table[(table["learner"] == "TOM") & (table["environment"] == PENDULUM)].iloc[0]
    assert row["n"] == 2
    assert row["final"] == pytest.approx(np.mean([v[-1] for v in values]))
    assert row["best"] == pytest.approx(np.mean([max(v) for v in values]))


def test_median_with_the_band_of_a_deviation(store: Path) -> None:
    app = draw("compare", env=PENDULUM, statistic="median", band="standard deviation", logy="true")
    values = np.array([recorded(store, run_id)[1] for run_id in SEEDS])
    line, band = (trace(figures(app)[0], name=name) for name in ("TOM (n = 2)", "band"))
    assert array(line["y"]) == pytest.approx(np.median(values, axis=0))
    assert array(band["y"])[-1] == pytest.approx((values.mean(0) - values.std(0, ddof=1))[0])
    assert figures(app)[0]["layout"]["yaxis"]["type"] == "log"


def test_any_metric_over_wall_time_and_shares_of_the_run(store: Path) -> None:
    app = draw("compare", env="road-and-rocks", measure="running maximum")
    line = trace(figures(app)[0], name="TOM (1 seed, no band)")
    assert array(line["y"]).tolist() == recorded(store, ROAD_TOM, "eval/return_max")[1]
    query = {"text": PENDULUM_TOM, "measure": "another metric", "metric": "weights/ess"}
    steps, ess = recorded(store, PENDULUM_TOM, "weights/ess")
    at, minutes = recorded(store, PENDULUM_TOM, "time/wall_s")
    for x, expected in (
        ("share of the run", np.array(steps) / 400),
        ("wall time, minutes", np.interp(steps, at, minutes) / 60),
    ):
        line = figures(draw("compare", **query, x=x))[0]["data"][-1]
        assert array(line["x"]) == pytest.approx(expected)
        assert array(line["y"]) == pytest.approx(ess)


def test_hidden_and_pinned_runs() -> None:
    app = draw("compare", env=PENDULUM, hide=SEEDS[1])
    assert trace(figures(app)[0], name="TOM (1 seed, no band)")["meta"] == SEEDS[0]
    pinned = draw("compare", env="road-and-rocks", pin="pendulum-mle-0")
    assert set(pinned.dataframe[0].value["environment"]) == {"road-and-rocks", PENDULUM}


def test_a_hidden_group_stays_in_the_legend_and_counts_nowhere() -> None:
    app, both = draw("compare", env=PENDULUM, hide="TOM"), ["TOM", "MLE"]
    assert trace(figures(app)[0], name="TOM (n = 2)")["visible"] == "legendonly"
    assert app.dataframe[0].value["learner"].tolist() == ["MLE"]
    assert app.query_params["hide"] == "TOM"
    hide(app, toggled(hidden(app), "TOM"))
    assert "visible" not in trace(figures(app)[0], name="TOM (n = 2)")
    assert "hide" not in app.query_params
    hide(app, switched([], both, both))
    assert {line["visible"] for line in figures(app)[0]["data"]} == {"legendonly"}
    assert not app.dataframe
    assert rows(app) == {"TOM": True, "MLE": True}
    hide(app, switched(hidden(app), ["MLE"], both))
    assert rows(app) == {"TOM": False, "MLE": True}
    assert app.dataframe[0].value["learner"].tolist() == ["TOM"]


def test_any_setting_makes_groups(store: Path) -> None:
    app = draw("compare", env=PENDULUM, group="seed")
    first, second = (
        trace(figures(app)[0], name=f"seed {seed} ({n})")
        for seed, n in ((0, "n = 2"), (1, "1 seed, no band"))
    )
    assert first["meta"] == ["pendulum-mle-0", SEEDS[0]]
    values = np.array([recorded(store, run_id)[1] for run_id in first["meta"]])
    assert array(first["y"]) == pytest.approx(values.mean(0))
    assert first["line"]["color"] != second["line"]["color"]
    assert app.dataframe[0].value["settings"].tolist() == ["seed 0", "seed 1"]
    statistics = draw("compare", env=PENDULUM, group="seed", show="Statistics")
    assert statistics.dataframe[0].value["group"].tolist() == ["seed 0", "seed 1"]
    assert trace(figures(statistics)[0], name="seed 0")["line"] == {**first["line"], "width": 2.4}


def test_a_run_that_was_cut_short_does_not_count_in_its_group(own: Path) -> None:
    for state, n in (("stopped", 1), ("running", 2)):
        run = own / SEEDS[1]
        (run / layout.LOCK).unlink(missing_ok=True)  # as if another machine wrote it
        set_status(run, state=state, env_step=200, heartbeat=time.time() + 20)
        (run / layout.METRICS).write_text('{"env_step": 200, "eval/return": 5.0}\n')
        (run / layout.METRICS_TABLE).unlink(missing_ok=True)
        app = draw("compare", env=PENDULUM)
        table = app.dataframe[0].value.set_index("learner")
        assert table.loc["TOM", "n"] == n
        assert ("seed 1" in captions(app)) == (n == 1)


def test_a_click_on_a_mean_opens_the_replay_of_the_run_nearest_to_it() -> None:
    curves = [
        Curve(run_id, "e", "tom", "p", i, np.array([0.0, 100.0]), np.array([0.0, value]))
        for i, (run_id, value) in enumerate((("low", 10.0), ("high", 20.0)))
    ]
    assert nearest(curves, 50.0, 9.0) == "high"
    assert nearest(curves, 50.0, 6.0) == "low"
    ended = Curve("ended", "e", "tom", "p", 2, np.array([0.0, 40.0]), np.array([0.0, 9.0]))
    assert nearest([*curves, ended], 50.0, 9.0) == "high"
    assert nearest([ended], 50.0, 9.0) == ""
    app = draw("compare", env=PENDULUM)
    assert trace(figures(app)[0], name="TOM (n = 2)")["meta"] == list(SEEDS)
    app.session_state[replay_link.CLICKED] = (SEEDS[1], 399)  # as `remember` does
    app.run()
    for shown in (app, draw("compare", env=PENDULUM, replay=f"{SEEDS[1]}~399")):
        assert any("seed 1, step 400" in words.value for words in shown.markdown)
        shown.button(key="close replay").click().run()
        assert "replay" not in shown.query_params
    draw("compare", replay="no-such-run~" + "9" * 5000)


@given(hypothesis.floats(-1e9, 1e9), hypothesis.floats(1e-6, 1e6), hypothesis.sampled_from("xy"))
def test_a_zoom_is_read_as_it_was_written(low: float, width: float, axis: str) -> None:
    seen = View(**{axis: zoom.part([str(low), str(low + width)])})
    word = zoom.to_word("gymnasium:Ant~v5", seen)
    assert zoom.from_words([word]) == ({} if seen == View() else {"gymnasium:Ant~v5": seen})
    for nothing in ("", "ant", "ant~1~2", "ant~2~1~~", "ant~nan~1~~", "~~~~"):
        assert zoom.from_words([nothing]) == {}


def test_a_name_is_a_regular_expression() -> None:
    assert draw("compare", text="TOM-[1-9]$").dataframe[0].value["seeds"].tolist() == ["1"]
    assert draw("compare", text="[").warning
    assert not figures(draw("compare", text="no such run"))


def test_a_name_in_a_link_cannot_hold_the_studio_up(store: Path) -> None:
    run = info(store, SEEDS[0])
    longest = altered(run, run_id="a" * 100)  # a backtracking search would never end
    assert matching([longest], "(a+)+!") == []
    assert matching([longest, run], "^a+$") == [longest]


def test_statistics_are_those_of_the_scores(store: Path) -> None:
    app = draw("compare", show="Statistics", task=PENDULUM, env=PENDULUM)
    profile, improvement = figures(app)[:2]
    tom = np.array([recorded(store, run_id)[1][-1] for run_id in SEEDS])
    mle = recorded(store, "pendulum-mle-0")[1][-1]
    line = trace(profile, name="TOM", mode="lines")
    at, share = array(line["x"]), array(line["y"])
    assert set(tom) < set(at)
    assert share[::2] == pytest.approx([(tom > score).mean() for score in at[::2]])
    assert share[1::2] == pytest.approx([(tom >= score).mean() for score in at[1::2]])  # until then
    wins = np.mean([1.0 if mle > t else 0.5 if mle == t else 0.0 for t in tom])
    assert array(improvement["data"][0]["x"]) == pytest.approx([wins])
    exact = mannwhitneyu([mle], tom, method="exact").pvalue
    (shown,) = improvement["data"][1]["text"]
    assert float(shown.removeprefix("p ")) == pytest.approx(exact, abs=0.02)
    aggregates, reached = (frame.value for frame in app.dataframe)
    assert aggregates.set_index("group").loc["TOM", "mean"].startswith(f"{tom.mean():.4g}")
    app.number_input[0].set_value(float(tom.min())).run()
    reached = app.dataframe[1].value.set_index("group")
    assert reached.loc["TOM", "reached"] == "2 of 2"
    app.selectbox(key="score").select(BEST).run()
    everything = [recorded(store, run_id)[1] for run_id in (*SEEDS, "pendulum-mle-0")]
    best = np.array([max(values) for values in everything])
    assert app.number_input[0].value == default_level(best)


def test_a_profile_has_the_same_band_beside_any_other_group(
    store: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown: list[Profile] = []
    monkeypatch.setattr(
        numbers, "profiles", lambda of, *rest: shown.extend(of) or statistics.profiles(of, *rest)
    )
    scores = {look: np.random.default_rng(n).normal(size=20) for n, look in enumerate(LOOKS)}
    first, second = LOOKS
    for looks in ([first, second], [second, first]):
        numbers._profiles(looks, [scores[look] for look in looks], FINAL, "")
    bands = [[(one.low, one.high) for one in shown if one.look == look] for look in LOOKS]
    for before, after in bands:
        assert np.array_equal(before, after)


def test_scores_are_those_up_to_the_step_that_every_run_reaches() -> None:
    step, value = np.array([100, 200, 300]), np.array([1.0, 5.0, 2.0])
    curve = Curve("a", "ant", "tom", "paper", 0, step, value)
    group = [curve]
    assert scores_of(group, FINAL, 200).tolist() == [5]
    assert scores_of(group, FINAL, 250).tolist() == [3.5]  # as the line has it
    assert scores_of(group, BEST, 100).tolist() == [1]
    assert scores_of(group, HEIGHT, 200).tolist() == [3]
    assert scores_of(group, HEIGHT, 100).tolist() == [1]


def test_rows_that_end_at_different_steps_are_told() -> None:
    def group(learner: str, last: int, env: str = "ant") -> Group:
        step = np.arange(100, last + 1, 100)
        return aggregate([Curve(learner, env, learner, "paper", 0, step, np.ones(len(step)))])

    assert unlike_ends([group("tom", 4000), group("mle", 2000)])
    assert not unlike_ends([group("tom", 4000), group("mle", 3900)])
    assert not unlike_ends([group("tom", 4000), group("mle", 2000, "hopper")])


@settings(deadline=None)
@given(hypothesis.floats(-1e5, 1e5), hypothesis.floats(1e-3, 1e4), hypothesis.integers(2, 9))
def test_the_level_lies_between_the_worst_and_the_best_run(
    low: float, spread: float, runs: int
) -> None:
    scores = np.linspace(low, low + spread, runs)
    assert scores.min() < default_level(scores) < scores.max()
    assert default_level(np.array([3456.7])) == 3456.7


def test_the_level_to_reach_is_in_the_address_until_another_score_is_chosen() -> None:
    app = draw("compare", show="Statistics", task=PENDULUM, env=PENDULUM, reach="2.25")
    assert app.number_input[0].value == 2.25
    app.number_input[0].set_value(3.5).run()
    assert app.query_params["reach"] == "3.5"
    app.selectbox(key="score").select(BEST).run()
    assert app.number_input[0].value != 3.5
    assert "reach" not in app.query_params


def test_the_step_of_the_replays_side_by_side_is_in_the_address(store: Path) -> None:
    chosen = {"show": "Side by side", "env": "road-and-rocks"}
    first, *_, last = RunReader(store / ROAD_TOM).evaluation_steps()
    app = draw("compare", **chosen)
    assert f", step {last:,}" in captions(app)
    assert "until" not in app.query_params
    app.select_slider(key="until").set_value(first).run()
    assert app.query_params["until"] == str(first)
    assert f", step {first:,}" in captions(app)


def test_more_runs_than_fit_side_by_side_are_cut_to_those_that_do() -> None:
    every = [*SEEDS, "pendulum-mle-0", "road-mle", "road-tom"]
    app = draw("compare", show="Side by side", side=every)
    assert app.multiselect(key="side").value == every[:4]
    assert app.query_params["side"] == every[:4]


def test_side_by_side_has_linked_axes(store: Path) -> None:
    app = draw("compare", show="Side by side", env=PENDULUM)
    figure = figures(app)[0]
    lines = [part for part in figure["data"] if part["type"] == "scatter"]
    maps = [part for part in figure["data"] if part["type"] == "heatmap"]
    assert len(lines) == len(maps) == 2
    for line in lines:
        assert array(line["y"]).tolist() == recorded(store, line["meta"])[1]
    layout = figure["layout"]
    assert {layout[axis].get("matches") for axis in ("xaxis2", "xaxis3", "xaxis4")} == {"x"}
    assert (layout["yaxis2"]["matches"], layout["yaxis4"]["matches"]) == ("y", "y3")


def test_settings_show_only_what_differs() -> None:
    app = draw("compare", show="Settings", env=PENDULUM)
    table = app.dataframe[0].value.set_index("setting")
    assert sorted(table.loc["seed"]) == ["0", "0", "1"]
    assert sorted(table.loc["learner"]) == ["mle", "tom", "tom"]
    assert "sac.lr" not in table.index


def test_a_run_gets_a_name_is_found_by_it_and_goes_to_the_trash_and_back(own: Path) -> None:
    app = draw("compare", show="Runs")
    app.multiselect(key="labelled").select(PENDULUM_TOM).run()
    app.text_input[-1].input("the good one")
    next(button for button in app.button if button.label == "Save").click().run()
    assert RunReader(own / PENDULUM_TOM).labels.name == "the good one"
    manage.tag(Store(own), PENDULUM_TOM, add=["keep"])
    found = draw("compare", show="Runs", tag="keep", text="GOOD")
    assert found.dataframe[0].value["run"].tolist() == [PENDULUM_TOM]
    click(app, "trash")
    assert not (own / PENDULUM_TOM).exists()
    app.multiselect(key="restored").select(PENDULUM_TOM).run()
    next(button for button in app.button if button.label == "Bring back").click().run()
    assert (own / PENDULUM_TOM / layout.CONFIG).exists()


def test_tags_of_several_runs_are_those_they_share_and_others_stay(own: Path) -> None:
    manage.tag(Store(own), SEEDS[0], add=["ours", "shared", "gone"])
    manage.tag(Store(own), SEEDS[1], add=["shared", "gone"])
    app = draw("compare", show="Runs")
    app.multiselect(key="labelled").set_value(list(SEEDS)).run()
    tags = next(part for part in app.multiselect if part.label == "Tags of these 2 runs")
    assert sorted(tags.value) == ["gone", "shared"]
    tags.set_value(["shared", "new"])
    next(button for button in app.button if button.label == "Save").click().run()
    assert not app.exception
    held = [set(RunReader(own / run_id).labels.tags) for run_id in SEEDS]
    assert held == [{"ours", "shared", "new"}, {"shared", "new"}]


def test_a_short_link_leads_to_the_same_view(own: Path) -> None:
    code = shortlinks.save(own, "compare", "env=hopper&x=a%2Fb")
    assert code == shortlinks.save(own, "compare", "env=hopper&x=a%2Fb")
    assert shortlinks.target(own, code) == "/compare?env=hopper&x=a%2Fb"
    assert not Store(own).problems
    held = own / ".views" / f"{code}.json"
    held.write_text(json.dumps({"page": "/evil.example", "query": ""}))
    assert shortlinks.target(own, code) is None
    assert shortlinks.target(own, "../../etc") is None
    assert any(route.path == "/v/{code}" for route in routes(Links(store=str(own))))
    with pytest.raises(UserError, match="8,001"):
        shortlinks.save(own, "compare", "x" * 8001)
    shutil.rmtree(own / ".views")
    (own / ".views").write_text("in the way")
    app = draw("compare", env=PENDULUM)
    click(app, "short link")
    assert app.error
