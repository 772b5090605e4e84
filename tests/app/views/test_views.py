"""The pages, drawn on real recorded runs: their numbers are the runs' numbers."""

import json
import re
import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import numpy as np
import plotly.graph_objects as go
import pytest
from streamlit.testing.v1 import AppTest
from studio_pages import PAGE, TIMEOUT_S, array, draw, figures, set_links, trace
from studio_runs import PENDULUM_TOM, ROAD_MLE, ROAD_TOM, WAITING, altered, info, stand_in

from app.data import trainings
from app.data.called import names
from app.data.trainings import Started
from app.links import Links
from app.parts import replay_link
from app.parts.cards import NAMED, settings_line
from app.parts.cards import figures as figures_of
from app.views import live
from app.views.live import now, start, usual, watched
from app.views.weights import newest_fifth, play
from tom.envs import ENVS, OTHERS, Task
from tom.errors import UserError
from tom.plugins import CHARTS
from tom.record import layout
from tom.record.labels import Labels
from tom.record.reader import RunReader
from tom.training.presets import resolve
from tom.training.run import STOPPED

pytestmark = pytest.mark.usefixtures("studio")


def recorded(store: Path, run_id: str, metric: str) -> tuple[list[int], list[float]]:
    rows = RunReader(store / run_id).metrics()[["env_step", metric]].dropna()
    return rows["env_step"].tolist(), rows[metric].tolist()


def metric_values(app: AppTest) -> dict[str, str]:
    return {metric.label: metric.value for metric in app.metric}


@pytest.fixture
def long_after(monkeypatch: pytest.MonkeyPatch) -> None:
    """The last training has ended long ago."""
    monkeypatch.setattr(live, "RECENT_S", -1)


def test_live_follows_the_chosen_run(store: Path) -> None:
    app = draw("live", runs=PENDULUM_TOM)
    line = trace(figures(app)[0], meta=PENDULUM_TOM)
    step, value = recorded(store, PENDULUM_TOM, "eval/return")
    assert array(line["x"]).tolist() == step
    assert array(line["y"]).tolist() == value
    heat, profile = (figure["data"][0] for figure in figures(app)[1:3])
    bins = RunReader(store / PENDULUM_TOM).profiles().bins
    assert array(heat["customdata"]) == pytest.approx(bins.T)
    assert array(profile["y"]) == pytest.approx(bins[-1])
    assert metric_values(app)["last return"] == f"{value[-1]:,.1f}"


def test_live_refreshes_without_losing_the_zoom() -> None:
    layouts = [figure["layout"] for figure in figures(draw("live", runs=PENDULUM_TOM))]
    assert all(layout["uirevision"] for layout in layouts)


@pytest.mark.parametrize("view", ["live", "replays", "weights", "regions"])
def test_a_zoom_on_one_run_is_none_of_another(view: str) -> None:
    def zooms(run_id: str) -> list[str]:
        chosen = {"runs" if view == "live" else "run": run_id}
        return [figure["layout"]["uirevision"] for figure in figures(draw(view, **chosen))]

    first, second = zooms(PENDULUM_TOM), zooms("pendulum-tom-1")
    assert first
    assert not set(first) & set(second)
    assert zooms(PENDULUM_TOM) == first


def test_the_map_of_another_run_is_not_zoomed_as_the_last_one_was() -> None:
    app = draw("weights", run=PENDULUM_TOM)
    before = figures(app)[0]["layout"]["uirevision"]
    app.select_slider(key="step").set_value(200).run()
    assert figures(app)[0]["layout"]["uirevision"] == before
    app.selectbox(key="run").select("pendulum-tom-1").run()
    assert figures(app)[0]["layout"]["uirevision"] != before


@pytest.mark.usefixtures("long_after")
def test_live_says_whether_its_runs_were_chosen() -> None:
    def said(app: AppTest) -> str:
        return app.caption[0].value

    assert said(draw("live")).startswith("Nothing is training now: the last runs of road")
    app = draw("live", runs=[PENDULUM_TOM, ROAD_TOM])
    assert said(app) == "Nothing is training now: the runs chosen above"
    assert "the last runs" in said(draw("live", runs="gone"))


@pytest.mark.usefixtures("long_after")
def test_live_without_a_training_shows_each_learners_newest_run() -> None:
    names = [line["meta"] for line in figures(draw("live"))[0]["data"]]
    assert names == [ROAD_MLE, ROAD_TOM]


@pytest.mark.usefixtures("long_after")
def test_live_without_a_training_prefers_runs_with_weights_and_replays(
    store: Path, tmp_path: Path
) -> None:
    trained = info(store, PENDULUM_TOM)
    recording = altered(trained, run_id="recorded", env="hopper", learner="sac")
    assert watched([recording, trained], []) == [trained]
    assert watched([recording], []) == [recording]
    folder = shutil.copytree(store / PENDULUM_TOM, tmp_path / "bare")
    shutil.rmtree(folder / "episodes")
    bare = altered(trained, run_id="bare", path=folder)
    assert watched([bare, trained], []) == [trained]  # the newest, but without a replay
    assert watched([bare], []) == [bare]


def test_a_training_that_ends_stays_beside_the_next_and_before_small_copies(
    store: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ended = info(store, PENDULUM_TOM)
    recent = altered(ended, status=replace(ended.status, heartbeat=time.time()))
    status = replace(recent.status, state="running")
    trains = altered(recent, run_id="trains", learner="mle", status=status)
    copy = altered(recent, run_id="copy", learner="mle", small_copy=True)
    assert set(ids(watched([trains, recent, copy], []))) == {"trains", PENDULUM_TOM}
    many = [altered(recent, run_id=f"ended-{i}") for i in range(100)]
    assert len(watched([trains, *many], [])) == 1 + live.RECENT
    monkeypatch.setattr(live, "RECENT_S", -1)
    assert ids(watched([trains, recent], [])) == ["trains"]
    assert ids(watched([copy, recent], [])) == [PENDULUM_TOM]


def ids(runs: Sequence[RunReader]) -> list[str]:
    return [run.run_id for run in runs]


def test_a_chart_of_a_plugin_that_raises_takes_nothing_else_with_it(
    store: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    before = draw("live", runs=PENDULUM_TOM)
    first = usual([info(store, PENDULUM_TOM)])[0]

    def broken(*_: object) -> go.Figure:
        raise ZeroDivisionError("of a plug-in")

    monkeypatch.setitem(CHARTS, first, broken)
    app = AppTest.from_string(PAGE.format(view="live"), default_timeout=TIMEOUT_S)
    app.query_params["runs"] = PENDULUM_TOM
    app.run()
    assert len(app.exception) == 1
    assert len(figures(app)) == len(figures(before)) - 1


def test_a_stopped_card_says_how_to_go_on_from_any_folder(
    store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = shutil.copytree(store / PENDULUM_TOM, tmp_path / PENDULUM_TOM)
    status = json.loads((run / layout.STATUS).read_text())
    status |= {"state": "stopped", "reason": STOPPED.format(step=7, run=PENDULUM_TOM)}
    (run / layout.STATUS).write_text(json.dumps(status))
    set_links(Links(store=str(tmp_path), key="key"), monkeypatch)
    captions = [caption.value.replace("\\", "") for caption in draw("live").caption]
    assert sum("tom train --resume" in words for words in captions) == 1
    assert any(f"--resume {PENDULUM_TOM} --store {tmp_path}" in words for words in captions)


def test_runs_of_two_presets_have_two_names_on_live(
    store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ids = {"as-printed": "paper", "mended": "mended"}
    for run_id, preset in ids.items():
        folder = shutil.copytree(store / PENDULUM_TOM, tmp_path / run_id)
        config = json.loads((folder / "config.json").read_text())
        config |= {"run_id": run_id, "preset": preset}
        (folder / "config.json").write_text(json.dumps(config))
    set_links(Links(store=str(tmp_path), key="key"), monkeypatch)
    app = draw("live", runs=list(ids))
    shown = {line["meta"]: line["name"] for line in figures(app)[0]["data"]}
    assert shown == {"as-printed": "TOM paper s0", "mended": "TOM mended s0"}
    heads = " ".join(part.proto.body for part in app.get("html"))
    assert "TOM paper" in heads
    assert "TOM mended" in heads


def test_a_run_has_one_dash_on_live_also_where_another_has_no_fit_yet(
    store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for run_id in (PENDULUM_TOM, "pendulum-tom-1"):
        shutil.copytree(store / run_id, tmp_path / run_id)
    shutil.rmtree(tmp_path / PENDULUM_TOM / "weights")
    set_links(Links(store=str(tmp_path), key="key"), monkeypatch)
    charts = figures(draw("live", runs=[PENDULUM_TOM, "pendulum-tom-1"]))
    (profile,) = next(f for f in charts if f["layout"]["uirevision"].startswith("profile"))["data"]
    assert profile["line"]["dash"] == trace(charts[0], meta="pendulum-tom-1")["line"]["dash"]


def test_live_promises_no_fit_of_a_recording_of_sac(
    store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = shutil.copytree(store / PENDULUM_TOM, tmp_path / "recorded")
    shutil.rmtree(folder / "weights")
    config = json.loads((folder / "config.json").read_text())
    config |= {"run_id": "recorded", "learner": "sac"}
    (folder / "config.json").write_text(json.dumps(config))
    set_links(Links(store=str(tmp_path), key="key"), monkeypatch)
    app = draw("live")
    assert now.NO_MODEL in [caption.value for caption in app.caption]


def test_live_shows_chosen_curves(store: Path) -> None:
    app = draw("live", runs=PENDULUM_TOM, curves="model/holdout_nll")
    line = figures(app)[3]["data"][0]
    assert array(line["y"]).tolist() == recorded(store, PENDULUM_TOM, "model/holdout_nll")[1]


def test_a_card_names_the_preset_and_the_settings_that_make_a_run_another(
    store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    usual = resolve("inverted-pendulum", "tom", "mended").model_dump(mode="json")
    units = usual["model"]["hidden"]
    for name, preset, hidden in (("a", "paper", 8), ("b", "mended", 8), ("c", "mended", units)):
        folder = shutil.copytree(store / PENDULUM_TOM, tmp_path / name)
        config = json.loads((folder / "config.json").read_text())
        chosen = {**usual, "model": {**usual["model"], "hidden": hidden}}
        config |= {"run_id": name, "preset": preset, "config": chosen}
        (folder / "config.json").write_text(json.dumps(config))
    set_links(Links(store=str(tmp_path), key="key"), monkeypatch)
    app = draw("live", runs=["b"])  # the only one on the page, but not in the store
    assert "TOM mended" in app.get("html")[0].proto.body
    assert r"model\.hidden 8" in [caption.value for caption in app.caption]
    runs = {name: info(tmp_path, name) for name in "abc"}
    assert settings_line(runs["c"]) == ""
    assert settings_line(runs["a"]).endswith(" more")
    assert len(settings_line(runs["a"]).split(", ")) == NAMED + 1


def test_live_charts_no_speed_of_a_run_that_only_explores(store: Path, tmp_path: Path) -> None:
    run = explores(store, tmp_path)
    assert usual([run]) == []
    assert dict(figures_of(run))["steps / s"] == "-"  # a fit takes no step: that is no speed of 0


def explores(store: Path, tmp_path: Path) -> RunReader:
    """A run in training whose only metrics yet are those of the machine."""
    folder = shutil.copytree(store / PENDULUM_TOM, tmp_path / "young")
    (folder / "metrics.parquet").unlink()
    rows = [{"env_step": step, "time/checkpoint_s": 0.1} for step in (1, 2)]
    (folder / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    status = json.loads((folder / "status.json").read_text())
    status |= {"state": "running", "heartbeat": time.time(), "env_steps_per_s": 0.0}
    (folder / "status.json").write_text(json.dumps(status))
    (folder / layout.LOCK).unlink()
    return info(tmp_path, "young")


def test_live_loads_rerun_for_a_run_that_is_asked_for(
    store: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    links = Links(store=str(store), port=8600, rerun_port=9090, key="key")
    set_links(links, monkeypatch)
    app = draw("live")
    assert not app.get("iframe")
    app.selectbox(key="recording").select(PENDULUM_TOM).run()
    [frame] = app.get("iframe")
    [address] = parse_qs(urlsplit(frame.proto.src).query)["url"]
    assert urlsplit(address).path == f"/rrd/{PENDULUM_TOM}/run.rrd"


def test_live_follows_a_run_in_training_in_rerun(
    store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = explores(store, tmp_path)
    links = Links(store=str(tmp_path), port=8600, rerun_port=9090, key="key")
    set_links(links, monkeypatch)
    [frame] = draw("live", recording=run.run_id).get("iframe")
    [address] = parse_qs(urlsplit(frame.proto.src).query)["url"]
    assert urlsplit(address).path == f"/live/{run.run_id}.rrd"


def test_runs_are_chosen_by_name_and_kept_in_the_address_by_id() -> None:
    app = draw("weights", run=PENDULUM_TOM)
    choice = app.selectbox(key="run")
    assert choice.options[choice.index or 0] == "Inverted pendulum · TOM · seed 0"
    choice.select("pendulum-tom-1").run()
    assert app.query_params["run"] == "pendulum-tom-1"
    assert draw("live", runs=PENDULUM_TOM).multiselect(key="runs").value == [PENDULUM_TOM]


def test_only_runs_of_one_name_carry_their_ids(store: Path) -> None:
    def run(run_id: str, seed: int, name: str = "") -> RunReader:
        changes = {"run_id": run_id, "seed": seed, "labels": Labels(name=name), "env": "hopper"}
        return altered(info(store, PENDULUM_TOM), **changes)

    found = names([run("a", 0), run("b", 1), run("c", 1), run("d", 0, "the best")])
    assert list(found.values()) == [
        "Hopper · TOM · seed 0",
        "Hopper · TOM · seed 1, b",
        "Hopper · TOM · seed 1, c",
        "the best",
    ]


@pytest.mark.parametrize("page", ["live", "compare"])
def test_a_click_on_a_runs_curve_leads_to_the_replay_nearest_to_it(store: Path, page: str) -> None:
    app = draw(page)
    assert any("replay" in words.value for words in app.caption)
    before, at = RunReader(store / ROAD_TOM).evaluation_steps()[-2:]
    app.session_state[replay_link.CLICKED] = (ROAD_TOM, at - 1)  # as `remember` does
    app.run()
    assert before < at - 1
    address = f"(/replays?run={ROAD_TOM}&step={at})"
    assert any(address in words.value for words in app.markdown)


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
    assert shown.startswith("tom train --env hopper --learner tom --preset mended --seed 0")
    assert shown.endswith(f"--sac.lr=0.001 --store {store}")
    app.text_input(key="start set sac.discount").input("2").run()
    assert "discount" in app.error[0].value
    assert not [button for button in app.button if button.key == "start"]


def test_trainings_that_have_ended_are_forgotten_and_those_that_run_are_not(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def ended(words: Sequence[str]) -> Started:
        begun = stand_in(words, "")
        begun.process.wait(TIMEOUT_S)
        return begun

    monkeypatch.setattr(trainings, "start", lambda words: stand_in(words, WAITING))
    app = draw("live")
    app.session_state[start.FOLD] = True
    app.run().button(key="start").click().run()
    (first,) = start._started()
    try:
        monkeypatch.setattr(trainings, "start", ended)
        app.text_input(key="start seeds").input(f"1-{start.FORGET + 2}").run()
        app.button(key="start").click().run()
        assert len(start._started()) == 1 + start.FORGET
        assert not app.error
    finally:
        first.process.kill()
        first.process.wait(TIMEOUT_S)
    assert "did not begin" in app.run().error[0].value


def test_the_form_offers_the_tasks_of_plugins(store: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(OTHERS, "swimmer", lambda: replace(ENVS["hopper"], name="swimmer"))
    app = draw("live")
    app.session_state[start.FOLD] = True
    app.run().selectbox(key="start env").select("swimmer").run()
    assert not app.exception
    shown = next(code.value for code in app.code if "tom train" in code.value)
    assert shown.startswith("tom train --env swimmer --learner tom")


def test_the_form_says_why_a_task_cannot_be_trained_in(
    store: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken() -> Task:
        raise UserError("task broken cannot be made")

    monkeypatch.setitem(OTHERS, "broken", broken)
    app = draw("live")
    app.session_state[start.FOLD] = True
    app.run().selectbox(key="start env").select("broken").run()
    assert not app.exception
    assert "task broken cannot be made" in [error.value for error in app.error]


def test_the_forms_preset_is_the_learners_own_until_another_is_chosen(store: Path) -> None:
    app = draw("live")
    app.session_state[start.FOLD] = True
    app.run().selectbox(key="start env").select("hopper").run()
    preset, learner = "start preset", "start learner"
    assert app.selectbox(key=preset).value == "mended"
    assert app.selectbox(key=learner).select("mle").run().selectbox(key=preset).value == "paper"
    app.selectbox(key=preset).select("smoke").run()
    assert app.selectbox(key=learner).select("tom").run().selectbox(key=preset).value == "smoke"
    assert not app.warning
    assert not app.exception


def test_live_changes_nothing_where_others_can_open_it(
    store: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read_only_reason(
        Links(store=str(store), host="0.0.0.0", key="key"), monkeypatch, "change nothing"
    )


@pytest.mark.parametrize("key", ["", "another"])
def test_live_changes_nothing_where_the_browser_did_not_give_the_key(
    key: str, store: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read_only_reason(Links(store=str(store), key=key), monkeypatch, "open the address")


def read_only_reason(links: Links, monkeypatch: pytest.MonkeyPatch, why: str) -> None:
    """The form of a studio at these links is not drawn, and it says why."""
    set_links(links, monkeypatch)
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


def test_the_return_lies_under_the_map_on_the_same_axis(store: Path) -> None:
    figure = figures(draw("weights", run=PENDULUM_TOM))[0]
    heat, line = figure["data"]
    steps, values = recorded(store, PENDULUM_TOM, "eval/return")
    assert (array(line["x"]).tolist(), array(line["y"]).tolist()) == (steps, values)
    assert "xaxis" not in heat
    assert "xaxis" not in line
    assert line["yaxis"] == "y2"
    assert figure["layout"]["yaxis2"]["domain"][1] < figure["layout"]["yaxis"]["domain"][0]


def test_profiles_of_all_fits_have_one_height(store: Path) -> None:
    steps = RunReader(store / PENDULUM_TOM).profiles().env_step.tolist()
    ranges = [
        figures(draw("weights", run=PENDULUM_TOM, step=str(step)))[1]["layout"]["yaxis"]["range"]
        for step in (steps[0], steps[-1])
    ]
    assert ranges[0] == ranges[1]
    assert ranges[0][1] >= RunReader(store / PENDULUM_TOM).profiles().bins.max()


def test_weights_plays_fit_after_fit(store: Path) -> None:
    steps = RunReader(store / PENDULUM_TOM).profiles().env_step.tolist()
    app = draw("weights", run=PENDULUM_TOM)
    app.button(key="play fits").click().run()
    seen = [app.select_slider(key="step").value]
    while app.button(key="play fits").label == "Pause":
        seen.append(app.run().select_slider(key="step").value)
    assert list(dict.fromkeys(seen)) == steps


def test_weights_of_a_fit_that_kept_none_are_not_those_of_another(
    store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = shutil.copytree(store / PENDULUM_TOM, tmp_path / "store" / "run")
    first, *_, last = RunReader(run).profiles().env_step.tolist()
    (run / layout.snapshot(last)).unlink()
    set_links(Links(store=str(run.parent), key="key"), monkeypatch)
    app = draw("weights", run="run", step=str(last))
    assert not any("go with" in words.value for words in app.markdown)
    choice = app.selectbox(key="kept fit")
    assert f"{last:,}" not in choice.options
    choice.select(first).run()
    assert any(f"of step {first:,} go with" in words.value for words in app.markdown)


def test_weights_says_where_a_fit_was_a_warm_up(
    store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = shutil.copytree(store / PENDULUM_TOM, tmp_path / "store" / "run")
    record = run / "weights" / "profiles.jsonl"
    first, *rest = record.read_text().splitlines()
    even = json.loads(first) | {"bins": [1.0] * 100, "ess": 1.0, "zeros": 0.0}
    record.write_text("\n".join([json.dumps(even), *rest]) + "\n")
    set_links(Links(store=str(run.parent), key="key"), monkeypatch)
    step, last = even["env_step"], json.loads(rest[-1])["env_step"]
    said = [
        any("warm-up" in caption.value for caption in draw("weights", run="run", step=at).caption)
        for at in (str(step), str(last))
    ]
    assert said == [True, False]
    notice = {"env_step": step, "kind": "degenerate-weights", "message": "every weight is zero"}
    with (run / "notices.jsonl").open("a") as file:
        file.write(json.dumps(notice) + "\n")
    captions = [caption.value for caption in draw("weights", run="run", step=str(step)).caption]
    assert any("weights were unusable" in words for words in captions)
    assert not any("warm-up" in words for words in captions)


def test_weights_starts_at_the_last_fit(store: Path) -> None:
    app = draw("weights", run=PENDULUM_TOM)
    bars = figures(app)[1]["data"][0]
    assert array(bars["y"]) == pytest.approx(RunReader(store / PENDULUM_TOM).profiles().bins[-1])


def test_weights_follows_the_last_fit_until_another_is_chosen(
    store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = shutil.copytree(store / PENDULUM_TOM, tmp_path / "store" / "live")
    set_links(Links(store=str(run.parent), key="key"), monkeypatch)
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
    set_links(Links(store=str(tmp_path), key="key"), monkeypatch)
    app = draw("weights", run="torn")
    assert not figures(app)
    assert any("line 1 is damaged" in warning.value for warning in app.warning)


def test_weights_survives_a_step_of_another_run() -> None:
    app = draw("weights", run=PENDULUM_TOM, step="200")
    app.selectbox(key="run").select(ROAD_TOM).run()
    assert not app.exception
    assert len(figures(app)) == 5  # no episodes and no policies: two panels less


@pytest.mark.parametrize(
    ("view", "run", "steps", "key", "more"),
    [
        ("weights", PENDULUM_TOM, lambda run: run.profiles().env_step.tolist(), "step", {}),
        ("regions", PENDULUM_TOM, RunReader.snapshot_steps, "step", {}),
        ("replays", PENDULUM_TOM, RunReader.evaluation_steps, "step", {}),
        ("road", ROAD_TOM, RunReader.snapshot_steps, "step", {}),
        ("probe", PENDULUM_TOM, RunReader.policy_steps, "at", {}),
        ("compare", ROAD_TOM, RunReader.evaluation_steps, "until",
         {"show": "Side by side", "env": "road-and-rocks"}),
    ],
)  # fmt: skip
def test_a_link_with_a_step_that_was_not_kept_names_the_nearest(
    view: str,
    run: str,
    steps: Callable[[RunReader], list[int]],
    key: str,
    more: dict[str, str],
    store: Path,
) -> None:
    first, *_ = steps(RunReader(store / run))
    app = draw(view, run=run, **more, **{key: str(first + 1)})
    assert app.query_params[key] == str(first)
    words = f"Step {first + 1:,} was not kept; this is the nearest, {first:,}."
    assert words in [caption.value for caption in app.caption]
    again = draw(view, run=run, **more, **{key: app.query_params[key]})
    assert again.query_params[key] == str(first)
    assert not any("not kept" in caption.value for caption in again.caption)


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
    set_links(Links(store=str(tmp_path / "new one"), key="key"), monkeypatch)
    app = AppTest.from_string("from app.router import run\nrun()", default_timeout=TIMEOUT_S).run()
    assert not app.exception
    commands = [code.value for code in app.code]
    assert any(command.startswith("tom demo") for command in commands)
    assert any("tom train" in command and "'" in command for command in commands)


@pytest.mark.usefixtures("long_after")
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
    set_links(Links(store=str(tmp_path), key="key"), monkeypatch)
    app = draw(view, **({"run": "bad"} if view in ("regions", "replays") else {}))
    assert figures(app)
    assert view in ("weights", "probe") or any("bad" in warning.value for warning in app.warning)
    assert "<img" not in json.dumps(figures(app))
    for element in (*app.markdown, *app.caption, *app.warning):
        assert not re.search(r"(?<!\\)!\[|(?<!\\)<img", element.value)
    for block in app.get("html"):
        assert "<img" not in block.proto.body


METRIC = "<img src=x>![x](http://evil/y.png) :material/delete:"


@pytest.fixture
def hostile_metric(studio: Links, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The studio of a run whose record has a metric of that name, and nothing else."""
    folder = shutil.copytree(Path(studio.store) / PENDULUM_TOM, tmp_path / "store" / "hostile")
    (folder / "metrics.parquet").unlink(missing_ok=True)
    rows = [{"env_step": step, METRIC: step, "eval/return": 1.0} for step in (100, 200)]
    (folder / "metrics.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    set_links(Links(store=str(folder.parent), key="key"), monkeypatch)


@pytest.mark.usefixtures("hostile_metric")
def test_live_shows_the_name_of_a_metric_as_words() -> None:
    (heading,) = [part for part in draw("live", curves=METRIC).markdown if "evil" in part.value]
    for shown in (heading.value, heading.proto.help):
        assert re.sub(r"[\\\u2060]", "", shown.strip("*")) == METRIC
        assert not re.search(r"(?<!\\)(!\[|<img|:material)", shown)


@pytest.mark.usefixtures("hostile_metric")
def test_compare_shows_the_name_of_a_metric_on_its_axis_as_words() -> None:
    (figure,) = figures(draw("compare", x=METRIC))
    assert figure["layout"]["xaxis"]["title"]["text"].startswith("&lt;img src=x&gt;")


def test_the_road_map_shows_the_name_of_a_learner_as_words(
    store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = shutil.copytree(store / ROAD_TOM, tmp_path / "bad")
    config = json.loads((folder / "config.json").read_text()) | {"learner": "<img src=x>"}
    (folder / "config.json").write_text(json.dumps(config))
    set_links(Links(store=str(tmp_path), key="key"), monkeypatch)
    names = [line.get("name") for line in figures(draw("road", run="bad"))[0]["data"]]
    assert "&lt;img src=x&gt; policy" in names


def test_a_playback_ends_at_the_last_fit_whatever_the_browser_s_slider_says(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The browser may send the fit before once more, with a tick that was under way."""
    state: dict[str, object] = {play.PLAYS: True, "step": 300}
    monkeypatch.setattr(play.st, "session_state", state)
    monkeypatch.setattr(play.st, "rerun", lambda: state.update(step=200))
    monkeypatch.setattr(play, "_tick", lambda step: None)
    monkeypatch.setattr(play.st, "button", lambda *_, **__: False)
    play.go_on([100, 200, 300], 2)
    assert not play.button([100, 200, 300])
    assert (state["step"], state[play.PLAYS]) == (300, False)


@pytest.mark.parametrize("bins", [3, 7, 64, 100])
def test_the_newest_fifth_is_a_fifth_for_any_number_of_bins(bins: int) -> None:
    assert newest_fifth(np.ones(bins)) == pytest.approx(0.2)
    assert newest_fifth(np.eye(bins)[-1]) == pytest.approx(min(1, 0.2 * bins))
    assert np.isnan(newest_fifth(np.zeros(bins)))
