"""The Compare page on real recorded runs: its numbers are the runs' numbers."""

import json
import queue
import shutil
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as hypothesis
from scipy.stats import mannwhitneyu
from streamlit.testing.v1 import AppTest
from studio_pages import answers, array, draw, figures, set_links, trace
from studio_runs import PENDULUM_TOM, altered, info

from app.data.readers import profiles
from app.data.tables import default_level, reached
from app.figures import statistics
from app.figures.looks import Look
from app.figures.side import side_by_side
from app.figures.statistics import Profile
from app.links import Links
from app.parts import replay_link, shortlinks, widgets
from app.parts.plot import View
from app.scenes.control import ReplayChoice, Selection, listen
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
SEEDS = ("pendulum-tom-0", "pendulum-tom-1")
LOOKS = (
    Look("TOM", learner_colour("tom"), "solid", "circle"),
    Look("MLE", learner_colour("mle"), "solid", "circle"),
)


def recorded(store: Path, run_id: str, metric: str = "eval/return") -> tuple[list, list]:
    rows = RunReader(store / run_id).metrics()[["env_step", metric]].dropna()
    return rows["env_step"].tolist(), rows[metric].tolist()


@pytest.fixture
def own(store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A copy of the store that a page may write to."""
    path = shutil.copytree(store, tmp_path / "own")
    set_links(Links(store=str(path), key="key"), monkeypatch)
    return path


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


def views(app: AppTest) -> list[dict]:
    return [data["view"] for data in parts(app, "tom_plot")]


def test_a_click_on_a_mean_opens_the_replay_of_the_run_nearest_to_it(store: Path) -> None:
    curves = [
        Curve(run_id, "e", "tom", "p", i, np.array([0.0, 100.0]), np.array([0.0, value]))
        for i, (run_id, value) in enumerate((("low", 10.0), ("high", 20.0)))
    ]
    assert nearest(curves, 50.0, 9.0) == "high"
    assert nearest(curves, 50.0, 6.0) == "low"
    ended = Curve("ended", "e", "tom", "p", 2, np.array([0.0, 40.0]), np.array([0.0, 9.0]))
    assert nearest([*curves, ended], 50.0, 9.0) == "high"
    assert nearest([ended], 50.0, 9.0) == ""
    app = draw("compare", env="inverted-pendulum")
    line = trace(figures(app)[0], name="TOM (n = 2)")
    assert line["meta"] == list(SEEDS)
    app.session_state[replay_link.CLICKED] = (SEEDS[1], 399)  # as `remember` does
    app.run()
    said = next(words.value for words in app.markdown if "Replay of" in words.value)
    assert "seed 1, step 400" in said
    assert "nearest that is kept to step 399" in said
    app.button(key="close replay").click().run()
    assert not any("Replay of" in words.value for words in app.markdown)


def test_lines_share_one_label_from_the_highest_on() -> None:
    layout = figures(draw("compare", env="inverted-pendulum"))[0]["layout"]
    assert (layout["hovermode"], layout["hoversort"]) == ("x unified", "value descending")


def test_median_with_the_band_of_a_deviation(store: Path) -> None:
    query = {"env": "inverted-pendulum", "statistic": "median", "band": "standard deviation"}
    app = draw("compare", **query)
    line = trace(figures(app)[0], name="TOM (n = 2)")
    values = np.array([recorded(store, run_id)[1] for run_id in SEEDS])
    assert array(line["y"]) == pytest.approx(np.median(values, axis=0))
    band = trace(figures(app)[0], name="band")
    assert array(band["y"])[-1] == pytest.approx((values.mean(0) - values.std(0, ddof=1))[0])
    assert any("median over seeds" in caption.value for caption in app.caption)


def test_wall_time_and_shares_of_the_run_as_the_axis(store: Path) -> None:
    query = {"text": PENDULUM_TOM, "measure": "another metric", "metric": "weights/ess"}
    steps, ess = recorded(store, PENDULUM_TOM, "weights/ess")
    line = figures(draw("compare", **query, x="share of the run"))[0]["data"][-1]
    assert array(line["x"]) == pytest.approx(np.array(steps) / 400)
    line = figures(draw("compare", **query, x="wall time, minutes"))[0]["data"][-1]
    frame = RunReader(store / PENDULUM_TOM).metrics()
    at = frame[["env_step", "time/wall_s"]].dropna()
    assert array(line["x"]) == pytest.approx(
        np.interp(steps, at["env_step"], at["time/wall_s"]) / 60
    )
    assert array(line["y"]) == pytest.approx(ess)


def test_log_axes_and_smoothing_are_said() -> None:
    query = {"env": "inverted-pendulum", "logy": "true", "smoothing": "5 points"}
    layout = figures(draw("compare", **query))[0]["layout"]
    assert (layout["xaxis"]["type"], layout["yaxis"]["type"]) == ("linear", "log")
    assert "smoothed" in layout["annotations"][0]["text"]


def test_hidden_and_pinned_runs() -> None:
    hidden = draw("compare", env="inverted-pendulum", hide="pendulum-mle-0")
    assert hidden.dataframe[0].value["learner"].tolist() == ["TOM"]
    pinned = draw("compare", env="road-and-rocks", pin="pendulum-mle-0")
    assert set(pinned.dataframe[0].value["environment"]) == {"road-and-rocks", "inverted-pendulum"}


def test_a_hidden_group_stays_in_the_legend_and_counts_nowhere() -> None:
    app = draw("compare", env="inverted-pendulum", hide="TOM")
    figure = figures(app)[0]
    assert trace(figure, name="TOM (n = 2)")["visible"] == "legendonly"
    assert "visible" not in trace(figure, name="MLE (1 seed, no band)")
    assert app.dataframe[0].value["learner"].tolist() == ["MLE"]
    assert app.query_params["hide"] == "TOM"
    hide(app, toggled(hidden(app), "TOM"))
    assert "visible" not in trace(figures(app)[0], name="TOM (n = 2)")
    assert "hide" not in app.query_params


def test_a_hidden_run_is_no_member_of_its_group() -> None:
    app = draw("compare", env="inverted-pendulum", hide=SEEDS[1])
    assert trace(figures(app)[0], name="TOM (1 seed, no band)")["meta"] == SEEDS[0]
    hide(app, [])
    assert trace(figures(app)[0], name="TOM (n = 2)")["meta"] == list(SEEDS)


def test_everything_can_be_hidden_and_shown_again() -> None:
    app = draw("compare", env="inverted-pendulum")
    hide(app, switched([], ["TOM", "MLE"], ["TOM", "MLE"]))
    assert {line["visible"] for line in figures(app)[0]["data"]} == {"legendonly"}
    assert not app.dataframe
    assert rows(app) == {"TOM": True, "MLE": True}
    hide(app, switched(hidden(app), ["MLE"], ["TOM", "MLE"]))
    assert rows(app) == {"TOM": False, "MLE": True}
    assert app.dataframe[0].value["learner"].tolist() == ["TOM"]


def test_any_setting_makes_groups(store: Path) -> None:
    app = draw("compare", env="inverted-pendulum", group="seed")
    first, second = (
        trace(figures(app)[0], name=f"seed {seed} ({n})")
        for seed, n in ((0, "n = 2"), (1, "1 seed, no band"))
    )
    assert first["meta"] == ["pendulum-mle-0", SEEDS[0]]
    values = np.array([recorded(store, run_id)[1] for run_id in first["meta"]])
    assert array(first["y"]) == pytest.approx(values.mean(0))
    assert first["line"]["color"] != second["line"]["color"]
    assert app.dataframe[0].value["settings"].tolist() == ["seed 0", "seed 1"]
    assert any("differ in everything else" in caption.value for caption in app.caption)
    assert any("2 runs are few" in caption.value for caption in app.caption)
    statistics = draw("compare", env="inverted-pendulum", group="seed", show="Statistics")
    assert statistics.dataframe[0].value["group"].tolist() == ["seed 0", "seed 1"]
    assert any(caption.value.startswith("1 run") for caption in statistics.caption)
    assert trace(figures(statistics)[0], name="seed 0")["line"] == {**first["line"], "width": 2.4}


def test_grouped_by_learner_a_line_has_the_learner_s_colour() -> None:
    line = trace(figures(draw("compare", group="learner"))[0], name="TOM (n = 2)")
    assert line["line"]["color"] == learner_colour("tom")


def test_a_zoom_is_in_the_address_until_something_else_is_measured() -> None:
    at = "inverted-pendulum~150~300~~"
    app = draw("compare", zoom=at)
    assert views(app) == [{"x": [150, 300], "y": None}, {"x": None, "y": None}]
    app.toggle(key="logy").set_value(True).run()
    assert app.query_params["zoom"] == at
    held = app.session_state[zoom.ZOOM]
    app.session_state[zoom.ZOOM] = zoom.zoomed(held, "road-and-rocks", View(y=(-5.0, 2.5)))
    app.run()
    assert app.query_params["zoom"] == [at, "road-and-rocks~~~-5~2.5"]
    held = app.session_state[zoom.ZOOM]
    app.session_state[zoom.ZOOM] = zoom.zoomed(held, "inverted-pendulum", View())
    app.run()
    assert app.query_params["zoom"] == "road-and-rocks~~~-5~2.5"
    app.selectbox(key="x").select("share of the run").run()
    assert "zoom" not in app.query_params
    assert views(app) == [{"x": None, "y": None}] * 2


@given(hypothesis.floats(-1e9, 1e9), hypothesis.floats(1e-6, 1e6), hypothesis.sampled_from("xy"))
def test_a_zoom_is_read_as_it_was_written(low: float, width: float, axis: str) -> None:
    seen = View(**{axis: zoom.part([str(low), str(low + width)])})
    word = zoom.to_word("gymnasium:Ant~v5", seen)
    assert zoom.from_words([word]) == ({} if seen == View() else {"gymnasium:Ant~v5": seen})


@pytest.mark.parametrize("word", ["", "ant", "ant~1~2", "ant~2~1~~", "ant~nan~1~~", "~~~~"])
def test_what_is_no_zoom_zooms_nothing(word: str) -> None:
    assert zoom.from_words([word]) == {}


def test_the_open_replay_is_in_the_address() -> None:
    app = draw("compare", env="inverted-pendulum", replay=f"{SEEDS[1]}~399")
    assert any("seed 1, step 400" in words.value for words in app.markdown)
    app.button(key="close replay").click().run()
    assert "replay" not in app.query_params
    assert not draw("compare", replay="no-such-run~x").exception
    assert not draw("compare", replay="no-such-run~" + "9" * 5000).exception


def test_a_name_is_a_regular_expression() -> None:
    app = draw("compare", text="tom-[1-9]$")
    assert app.dataframe[0].value["seeds"].tolist() == ["1"]
    assert "no regular expression" in draw("compare", text="[").warning[0].value
    assert draw("compare", text="TOM-[1-9]$").dataframe[0].value["seeds"].tolist() == ["1"]


def test_a_name_in_a_link_cannot_hold_the_studio_up(store: Path) -> None:
    run = info(store, SEEDS[0])
    longest = altered(run, run_id="a" * 100)  # a backtracking search would never end
    assert matching([longest], "(a+)+!") == []
    assert matching([longest, run], "^a+$") == [longest]


def test_statistics_are_those_of_the_scores(store: Path) -> None:
    app = draw("compare", show="Statistics", task="inverted-pendulum", env="inverted-pendulum")
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


def test_the_steps_to_a_value_are_those_up_to_the_step_that_every_run_reaches() -> None:
    step = np.array([100, 200, 300])
    long = Curve("a", "ant", "tom", "paper", 0, step, np.array([1.0, 2.0, 9.0]))
    short = Curve("b", "ant", "mle", "paper", 0, step[:2], np.array([1.0, 5.0]))
    table = reached([aggregate([long]), aggregate([short])], ["TOM", "MLE"], 5.0, until=200)
    assert table["reached"].tolist() == ["0 of 1", "1 of 1"]
    assert table["first"].tolist()[1] == 200


@settings(deadline=None)
@given(hypothesis.floats(-1e5, 1e5), hypothesis.floats(1e-3, 1e4), hypothesis.integers(2, 9))
def test_the_level_lies_between_the_worst_and_the_best_run(
    low: float, spread: float, runs: int
) -> None:
    scores = np.linspace(low, low + spread, runs)
    assert scores.min() < default_level(scores) < scores.max()
    assert default_level(np.array([3456.7])) == 3456.7


def test_the_level_to_reach_is_in_the_address_until_another_score_is_chosen() -> None:
    chosen = {"show": "Statistics", "task": "inverted-pendulum", "env": "inverted-pendulum"}
    app = draw("compare", **chosen, reach="2.25")
    assert app.number_input[0].value == 2.25
    assert any("is 2.25;" in words.value for words in app.markdown)
    app.number_input[0].set_value(3.5).run()
    assert app.query_params["reach"] == "3.5"
    assert draw("compare", **chosen).number_input[0].value not in (2.25, 3.5)
    app.selectbox(key="score").select(BEST).run()
    assert app.number_input[0].value != 3.5
    assert "reach" not in app.query_params


def test_the_step_of_the_replays_side_by_side_is_in_the_address(store: Path) -> None:
    chosen = {"show": "Side by side", "env": "road-and-rocks"}
    first, *_, last = RunReader(store / "road-tom").evaluation_steps()

    def said(app: AppTest) -> set[str]:
        return {c.value.rpartition(", ")[2] for c in app.caption if ", step" in c.value}

    app = draw("compare", **chosen)
    assert said(app) == {f"step {last:,}"}
    assert "until" not in app.query_params
    app.select_slider(key="until").set_value(first).run()
    assert said(app) == {f"step {first:,}"}
    assert app.query_params["until"] == str(first)
    assert said(draw("compare", **chosen, until=str(first))) == {f"step {first:,}"}


def test_more_runs_than_fit_side_by_side_are_cut_to_those_that_do() -> None:
    every = [*SEEDS, "pendulum-mle-0", "road-mle", "road-tom"]
    app = draw("compare", show="Side by side", side=every)
    assert app.multiselect(key="side").value == every[:4]
    assert app.query_params["side"] == every[:4]


def test_a_zoom_on_the_statistics_of_one_task_is_none_of_another() -> None:
    profile, better = [
        {
            figures(draw("compare", show="Statistics", task=task))[at]["layout"]["uirevision"]
            for task in ("inverted-pendulum", "road-and-rocks")
        }
        for at in (0, 1)
    ]
    assert len(profile) == len(better) == 2


def test_side_by_side_has_linked_axes(store: Path) -> None:
    app = draw("compare", show="Side by side", env="inverted-pendulum")
    figure = figures(app)[0]
    lines = [part for part in figure["data"] if part["type"] == "scatter"]
    maps = [part for part in figure["data"] if part["type"] == "heatmap"]
    assert len(lines) == len(maps) == 2
    for line in lines:
        assert array(line["y"]).tolist() == recorded(store, line["meta"])[1]
    layout = figure["layout"]
    assert {layout[axis].get("matches") for axis in ("xaxis2", "xaxis3", "xaxis4")} == {"x"}
    assert (layout["yaxis2"]["matches"], layout["yaxis4"]["matches"]) == ("y", "y3")


def test_side_by_side_the_only_fit_of_a_run_is_wide_enough_to_see(store: Path) -> None:
    run = info(store, PENDULUM_TOM)
    kept = profiles(run)
    first = replace(kept, env_step=kept.env_step[:1], bins=kept.bins[:1])
    figure = side_by_side([("TOM", widgets.curve(run, "eval/return"), first)], "light", 400)
    drawn = figure.to_plotly_json()["data"]
    (only,) = (part for part in drawn if part["type"] == "heatmap")
    assert np.ptp(only["x"]) > 1


def test_play_all_starts_every_replay_of_the_page(
    store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: queue.Queue[tuple[str, Selection]] = queue.Queue()
    control = tmp_path / "control"
    listening = (str(control), lambda *words: told.put(words))
    threading.Thread(target=listen, args=listening, daemon=True).start()
    links = Links(store=str(store), viser_port=9, control=str(control))
    set_links(links, monkeypatch)
    while not answers(str(control)):
        time.sleep(0.01)
    app = draw("compare", show="Side by side", env="inverted-pendulum")
    next(button for button in app.button if button.label == "Play all").click().run()
    before, after = [dict(told.get(timeout=30) for _ in range(2)) for _ in range(2)]
    assert before.keys() == after.keys()
    for selections, played in ((before, 0), (after, 1)):
        for selection in selections.values():
            assert selection.compact
            assert isinstance(selection.choice, ReplayChoice)
            assert (selection.choice.step, selection.choice.played) == (400, played)


def test_settings_show_only_what_differs() -> None:
    app = draw("compare", show="Settings", env="inverted-pendulum")
    table = app.dataframe[0].value.set_index("setting")
    assert sorted(table.loc["seed"]) == ["0", "0", "1"]
    assert sorted(table.loc["learner"]) == ["mle", "tom", "tom"]
    assert "sac.lr" not in table.index


def test_a_run_gets_a_name_and_a_tag_and_is_found_by_them(own: Path) -> None:
    app = draw("compare", show="Runs")
    app.multiselect(key="labelled").select(PENDULUM_TOM).run()
    app.text_input[-1].input("the good one")
    app.text_area[0].input("look at step 400")
    next(button for button in app.button if button.label == "Save").click().run()
    assert not app.exception
    labels = RunReader(own / PENDULUM_TOM).labels
    assert (labels.name, labels.note) == ("the good one", "look at step 400")
    manage.tag(Store(own), PENDULUM_TOM, add=["keep"])
    app = draw("compare", show="Runs", tag="keep", text="GOOD")
    assert app.dataframe[0].value["run"].tolist() == [PENDULUM_TOM]
    assert not app.warning


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


def test_a_run_goes_to_the_trash_and_comes_back(own: Path) -> None:
    app = draw("compare", show="Runs")
    app.multiselect(key="labelled").select(PENDULUM_TOM).run()
    click(app, "trash")
    assert not (own / PENDULUM_TOM).exists()
    app.multiselect(key="restored").select(PENDULUM_TOM).run()
    next(button for button in app.button if button.label == "Bring back").click().run()
    assert (own / PENDULUM_TOM / "config.json").exists()


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


def test_a_view_that_cannot_be_kept_is_refused_in_a_sentence(own: Path) -> None:
    with pytest.raises(UserError, match="holds 8,000 characters, this view has 8,001"):
        shortlinks.save(own, "compare", "x" * 8001)
    assert not (own / ".views").exists()
    (own / ".views").write_text("in the way")
    app = draw("compare", env="inverted-pendulum")
    click(app, "short link")
    assert "cannot be kept" in app.error[0].value


def test_a_figure_without_intervals_speaks_of_those_of_the_table() -> None:
    def said(band: str) -> str:
        app = draw("compare", env="inverted-pendulum", band=band)
        return next(c.value for c in app.caption if "2 seeds are few" in c.value)

    assert "100 such intervals" in said("95 % bootstrap")
    assert "100 of the table's intervals" in said("standard deviation")


def test_a_run_that_was_cut_short_does_not_count_in_its_group(own: Path) -> None:
    def lines() -> tuple[dict, list[str]]:
        app = draw("compare", env="inverted-pendulum")
        table = next(t.value for t in app.dataframe if "n" in t.value and "final" in t.value)
        tom = table[table["learner"] == "TOM"].iloc[0]
        return tom[["n", "steps", "final"]].to_dict(), [words.value for words in app.caption]

    whole, _ = lines()
    assert whole["n"] == 2
    for state, n in (("stopped", 1), ("running", 2)):
        run = own / SEEDS[1]
        (run / layout.LOCK).unlink(missing_ok=True)  # as if another machine wrote it
        status = json.loads((run / "status.json").read_text())
        status |= {"state": state, "env_step": 200, "heartbeat": time.time() + 20}
        (run / "status.json").write_text(json.dumps(status))
        (run / "metrics.jsonl").write_text('{"env_step": 200, "eval/return": 5.0}\n')
        (run / "metrics.parquet").unlink(missing_ok=True)
        told, said = lines()
        assert told["n"] == n
        assert any("seed 1" in words and "200" in words for words in said) == (n == 1)
