"""The pages, drawn on real recorded runs: their numbers are the runs' numbers."""

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from streamlit.testing.v1 import AppTest
from studio_pages import TIMEOUT_S, array, draw, figures, trace
from studio_runs import PENDULUM_TOM, ROAD_MLE, ROAD_TOM

from app.links import Links
from app.parts import replay_link
from app.views.live import start
from tom.record.reader import RunReader

pytestmark = pytest.mark.usefixtures("studio")


def recorded(store: Path, run_id: str, metric: str) -> tuple[list[int], list[float]]:
    rows = RunReader(store / run_id).metrics()[["env_step", metric]].dropna()
    return rows["env_step"].tolist(), rows[metric].tolist()


def metric_values(app: AppTest) -> dict[str, str]:
    return {metric.label: metric.value for metric in app.metric}


def test_live_follows_the_chosen_run(store: Path) -> None:
    app = draw("live", runs=PENDULUM_TOM)
    line = trace(figures(app)[0], meta=PENDULUM_TOM)
    step, value = recorded(store, PENDULUM_TOM, "eval/return")
    assert array(line["x"]).tolist() == step
    assert array(line["y"]).tolist() == value
    profile = figures(app)[1]["data"][0]
    assert array(profile["y"]) == pytest.approx(RunReader(store / PENDULUM_TOM).profiles().bins[-1])
    assert metric_values(app)["last return"] == f"{value[-1]:,.1f}"


def test_live_refreshes_without_losing_the_zoom() -> None:
    layouts = [figure["layout"] for figure in figures(draw("live", runs=PENDULUM_TOM))]
    assert all(layout["uirevision"] for layout in layouts)


def test_live_without_a_training_shows_each_learners_newest_run() -> None:
    names = [line["meta"] for line in figures(draw("live"))[0]["data"]]
    assert names == [ROAD_MLE, ROAD_TOM]


def test_live_shows_chosen_curves(store: Path) -> None:
    app = draw("live", runs=PENDULUM_TOM, curves="model/holdout_nll")
    line = figures(app)[2]["data"][0]
    assert array(line["y"]).tolist() == recorded(store, PENDULUM_TOM, "model/holdout_nll")[1]


@pytest.mark.parametrize("page", ["live", "compare"])
def test_a_click_on_a_runs_curve_leads_to_the_replay_nearest_to_it(store: Path, page: str) -> None:
    app = draw(page)
    assert any("for its replay" in words.value for words in app.caption)
    before, at = RunReader(store / ROAD_TOM).evaluation_steps()[-2:]
    app.session_state[replay_link.CLICKED] = (ROAD_TOM, at - 1)  # as `remember` does
    app.run()
    assert before < at - 1
    address = f"(/replays?run={ROAD_TOM}&step={at})"
    assert any(words.value.endswith(address) for words in app.markdown)


def test_live_has_a_form_that_writes_the_command(store: Path) -> None:
    app = draw("live")
    assert not app.text_input
    app.session_state[start.FOLD] = True  # as a click on its title does
    app.run().selectbox(key="start env").select("hopper").run()
    app.session_state[start.FOLD] = False
    app.text_input(key="start seeds").input("0-1").run()
    app.text_input(key="start set sac.lr").input("0.001").run()
    assert app.button(key="start").label == "Start 2 trainings"
    shown = next(code.value for code in app.code if "tom train" in code.value)
    assert shown.startswith("tom train --env hopper --learner tom --preset paper --seed 0")
    assert shown.endswith(f"--sac.lr=0.001 --store {store}")
    app.text_input(key="start set sac.discount").input("2").run()
    assert "discount" in app.error[0].value
    assert not [button for button in app.button if button.key == "start"]


def test_live_changes_nothing_where_others_can_open_it(
    store: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    looks_on(Links(store=str(store), host="0.0.0.0", key="key"), monkeypatch, "change nothing")


@pytest.mark.parametrize("key", ["", "another"])
def test_live_changes_nothing_where_the_browser_did_not_give_the_key(
    key: str, store: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    looks_on(Links(store=str(store), key=key), monkeypatch, "open the address")


def looks_on(links: Links, monkeypatch: pytest.MonkeyPatch, why: str) -> None:
    """The form of a studio at these links is not drawn, and it says why."""
    for name, value in links.environment().items():
        monkeypatch.setenv(name, value)
    app = draw("live")
    app.session_state[start.FOLD] = True
    app.run()
    assert not app.button
    assert any(why in caption.value for caption in app.caption)


def test_compare_shows_the_mean_over_seeds(store: Path) -> None:
    app = draw("compare", env="inverted-pendulum")
    mean = trace(figures(app)[0], name="TOM (n = 2)")
    values = [recorded(store, f"pendulum-tom-{seed}", "eval/return")[1] for seed in (0, 1)]
    assert array(mean["y"]) == pytest.approx(np.mean(values, axis=0))
    assert trace(figures(app)[0], name="MLE (1 seed, no band)")
    table = app.dataframe[0].value
    row = table[table["learner"] == "TOM"].iloc[0]
    assert row["n"] == 2
    assert row["final"] == pytest.approx(np.mean([v[-1] for v in values]))
    assert row["best"] == pytest.approx(np.mean([max(v) for v in values]))


def test_compare_has_a_figure_an_environment() -> None:
    assert len(figures(draw("compare"))) == 2
    assert len(figures(draw("compare", env="road-and-rocks", learner="TOM"))[0]["data"]) == 1


def test_compare_can_show_the_running_maximum(store: Path) -> None:
    app = draw("compare", env="road-and-rocks", measure="running maximum")
    line = trace(figures(app)[0], name="TOM (1 seed, no band)")
    assert array(line["y"]).tolist() == recorded(store, ROAD_TOM, "eval/return_max")[1]


def test_compare_can_show_any_metric(store: Path) -> None:
    app = draw("compare", env="inverted-pendulum", measure="another metric", metric="weights/ess")
    line = trace(figures(app)[0], name="MLE (1 seed, no band)")
    assert array(line["y"]).tolist() == recorded(store, "pendulum-mle-0", "weights/ess")[1]


def test_compare_finds_runs_by_name() -> None:
    app = draw("compare", text="mle-0")
    assert len(figures(app)) == 1
    assert app.dataframe[0].value["learner"].tolist() == ["MLE"]
    assert not figures(draw("compare", text="no such run"))


def test_weights_shows_every_fit_and_the_chosen_one(store: Path) -> None:
    profiles = RunReader(store / PENDULUM_TOM).profiles()
    step = int(profiles.env_step[1])
    app = draw("weights", run=PENDULUM_TOM, step=str(step))
    heat, bars, sample = figures(app)[:3]
    assert array(heat["data"][0]["z"]) == pytest.approx(np.log2(profiles.bins.T).clip(-4, 4))
    assert array(bars["data"][0]["y"]) == pytest.approx(profiles.bins[1])
    assert array(sample["data"][0]["y"]) == pytest.approx(100 * profiles.ess)
    assert heat["layout"]["shapes"][0]["x0"] == step
    values = metric_values(app)
    assert values["transitions"] == f"{profiles.count[1]:,}"
    assert values["effective sample"] == f"{100 * profiles.ess[1]:.1f} %"


def test_weights_starts_at_the_last_fit(store: Path) -> None:
    app = draw("weights", run=PENDULUM_TOM)
    bars = figures(app)[1]["data"][0]
    assert array(bars["y"]) == pytest.approx(RunReader(store / PENDULUM_TOM).profiles().bins[-1])


def test_weights_follows_the_last_fit_until_another_is_chosen(
    store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = shutil.copytree(store / PENDULUM_TOM, tmp_path / "store" / "live")
    for name, value in Links(store=str(run.parent), key="key").environment().items():
        monkeypatch.setenv(name, value)
    record = run / "weights" / "profiles.jsonl"
    fit, steps = json.loads(record.read_text().splitlines()[-1]), (200, 400, 500, 600)
    lines = [json.dumps(fit | {"env_step": step}) + "\n" for step in steps]
    record.write_text("".join(lines[:2]))
    app = draw("weights", run="live")
    assert app.select_slider(key="step").value == steps[1]
    record.write_text("".join(lines[:3]))
    assert app.run().select_slider(key="step").value == steps[2]
    app.select_slider(key="step").set_value(steps[0]).run()
    record.write_text("".join(lines[:4]))
    assert app.run().select_slider(key="step").value == steps[0]
    assert not app.exception


def test_weights_names_a_run_whose_profiles_are_damaged(
    store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    torn = shutil.copytree(store / PENDULUM_TOM, tmp_path / "torn")
    (torn / "weights" / "profiles.jsonl").write_text("torn\n")
    for name, value in Links(store=str(tmp_path), key="key").environment().items():
        monkeypatch.setenv(name, value)
    app = draw("weights", run="torn")
    assert not figures(app)
    assert any("line 1 is damaged" in warning.value for warning in app.warning)


def test_weights_survives_a_step_of_another_run() -> None:
    app = draw("weights", run=PENDULUM_TOM, step="200")
    app.selectbox(key="run").select(ROAD_TOM).run()
    assert not app.exception
    assert len(figures(app)) == 5  # no episodes and no policies: two panels less


def test_road_shows_the_weights_over_the_map(store: Path) -> None:
    app = draw("road", run=ROAD_TOM)
    heat = trace(figures(app)[0], name="weights")
    weight = RunReader(store / ROAD_TOM).snapshot(60)["weight"].to_numpy()
    assert np.nanmax(array(heat["customdata"])) <= weight.max() + 1e-5
    share = recorded(store, ROAD_TOM, "weights/road_share")[1][-1]
    assert metric_values(app)["weight on the road"] == f"{100 * share:.1f} %"
    table = app.dataframe[0].value.set_index("run")
    assert table.loc[ROAD_TOM, "weight on the road"] == pytest.approx(share)
    assert table.loc[ROAD_MLE, "road : rocks, random data"] == pytest.approx(1, abs=0.01)


def test_road_shows_the_chosen_step(store: Path) -> None:
    app = draw("road", run=ROAD_TOM, step="0")
    policy = trace(figures(app)[0], name="TOM policy")
    first = RunReader(store / ROAD_TOM).field("trajectories", 0)["learnt_0"]
    assert array(policy["x"])[: len(first)] == pytest.approx(first[:, 0])


def test_the_pages_of_an_empty_store_say_what_to_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in Links(store=str(tmp_path / "new one"), key="key").environment().items():
        monkeypatch.setenv(name, value)
    app = AppTest.from_string("from app.router import run\nrun()", default_timeout=TIMEOUT_S).run()
    assert not app.exception
    commands = [code.value for code in app.code]
    assert any(command.startswith("tom demo") for command in commands)
    assert any("tom train" in command and "'" in command for command in commands)


@pytest.mark.parametrize(
    "view", ["live", "compare", "weights", "regions", "probe", "replays", "road"]
)
def test_a_hostile_and_damaged_run_is_shown_beside_the_others(
    view: str, store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in (ROAD_TOM, PENDULUM_TOM):
        shutil.copytree(store / name, tmp_path / name)
    bad = shutil.copytree(store / ROAD_TOM, tmp_path / "bad")
    config = json.loads((bad / "config.json").read_text())
    config["learner"] = "<img src=http://evil/x.png>![x](http://evil/y.png)"
    (bad / "config.json").write_text(json.dumps(config))
    (bad / "status.json").write_text("nonsense")
    (bad / "weights" / "profiles.jsonl").write_text('{"env_step": 1}\n{"bins"')
    for name, value in Links(store=str(tmp_path), key="key").environment().items():
        monkeypatch.setenv(name, value)
    app = draw(view, **({"run": "bad"} if view in ("regions", "replays") else {}))
    assert figures(app)
    assert view in ("weights", "probe") or any("bad" in warning.value for warning in app.warning)
    assert "<img" not in json.dumps(figures(app))
    for element in (*app.markdown, *app.caption, *app.warning):
        assert not re.search(r"(?<!\\)!\[|(?<!\\)<img", element.value)
    for block in app.get("html"):
        assert "<img" not in block.proto.body
