"""Live: the runs in training, their numbers, and the form that starts more of them."""

import json
import shutil
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import plotly.graph_objects as go
import pytest
from streamlit.testing.v1 import AppTest
from studio_pages import (
    PAGE,
    TIMEOUT_S,
    array,
    captions,
    draw,
    figures,
    metrics,
    recorded,
    set_links,
    trace,
)
from studio_runs import PENDULUM_TOM, ROAD_MLE, ROAD_TOM, WAITING, altered, change, info, stand_in

from app.data import trainings
from app.data.trainings import Started
from app.links import Links
from app.parts import replay_link
from app.parts.cards import NAMED, settings_line
from app.parts.cards import figures as figures_of
from app.views import live
from app.views.live import start, usual, watched
from tom.envs import ENVS, OTHERS, Task
from tom.errors import UserError
from tom.plugins import CHARTS
from tom.record import layout
from tom.record.reader import RunReader
from tom.training.presets import resolve

pytestmark = pytest.mark.usefixtures("studio")
SECOND = "pendulum-tom-1"


def ids(runs: Sequence[RunReader]) -> list[str]:
    return [run.run_id for run in runs]


def test_the_chosen_run_is_shown(store: Path) -> None:
    app = draw("live", runs=PENDULUM_TOM, curves="model/holdout_nll")
    line = trace(figures(app)[0], meta=PENDULUM_TOM)
    step, value = recorded(store, PENDULUM_TOM)
    assert (array(line["x"]).tolist(), array(line["y"]).tolist()) == (step, value)
    assert metrics(app)["last return"] == f"{value[-1]:,.1f}"
    heat, profile, curve = (figure["data"][0] for figure in figures(app)[1:4])
    bins = RunReader(store / PENDULUM_TOM).profiles().bins
    assert array(heat["customdata"]) == pytest.approx(bins.T)
    assert array(profile["y"]) == pytest.approx(bins[-1])
    assert array(curve["y"]).tolist() == recorded(store, PENDULUM_TOM, "model/holdout_nll")[1]


def test_without_a_training_each_learners_newest_run_is_shown(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(live, "RECENT_S", -1)
    assert [line["meta"] for line in figures(draw("live"))[0]["data"]] == [ROAD_MLE, ROAD_TOM]


def test_without_a_training_runs_with_weights_and_replays_come_first(
    store: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(live, "RECENT_S", -1)
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


def test_a_chart_of_a_plugin_that_raises_takes_nothing_else_with_it(
    store: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = draw("live", runs=PENDULUM_TOM)

    def broken(*_: object) -> go.Figure:
        raise ZeroDivisionError("of a plug-in")

    monkeypatch.setitem(CHARTS, usual([info(store, PENDULUM_TOM)])[0], broken)
    app = AppTest.from_string(PAGE.format(view="live"), default_timeout=TIMEOUT_S)
    app.query_params["runs"] = PENDULUM_TOM
    app.run()
    assert len(app.exception) == 1
    assert len(figures(app)) == len(figures(before)) - 1


def test_runs_of_two_presets_have_two_names_and_their_other_settings_are_named(own: Path) -> None:
    usual = resolve("inverted-pendulum", "tom", "mended").model_dump(mode="json")
    units = usual["model"]["hidden"]
    for name, preset, hidden in (("a", "paper", 8), ("b", "mended", 8), ("c", "mended", units)):
        folder = shutil.copytree(own / PENDULUM_TOM, own / name)
        chosen = {**usual, "model": {**usual["model"], "hidden": hidden}}
        change(folder / layout.CONFIG, run_id=name, preset=preset, config=chosen)
    app = draw("live", runs=["a", "b"])
    shown = {line["meta"]: line["name"] for line in figures(app)[0]["data"]}
    assert shown == {"a": "TOM paper s0", "b": "TOM mended s0"}
    assert "model.hidden 8" in captions(app)
    runs = {name: info(own, name) for name in "abc"}
    assert settings_line(runs["c"]) == ""
    assert settings_line(runs["a"]).endswith(" more")
    assert len(settings_line(runs["a"]).split(", ")) == NAMED + 1


def test_a_run_has_one_dash_also_where_another_has_no_fit_yet(own: Path) -> None:
    shutil.rmtree(own / PENDULUM_TOM / "weights")
    charts = figures(draw("live", runs=[PENDULUM_TOM, SECOND]))
    (profile,) = next(f for f in charts if f["layout"]["uirevision"].startswith("profile"))["data"]
    assert profile["line"]["dash"] == trace(charts[0], meta=SECOND)["line"]["dash"]


def test_a_run_that_only_explores_has_no_speed_and_is_followed_in_rerun(
    own: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = own / PENDULUM_TOM
    (folder / layout.METRICS_TABLE).unlink()
    rows = [{"env_step": step, "time/checkpoint_s": 0.1} for step in (1, 2)]
    (folder / layout.METRICS).write_text("".join(json.dumps(row) + "\n" for row in rows))
    alive = {"state": "running", "heartbeat": time.time(), "env_steps_per_s": 0.0}
    change(folder / layout.STATUS, **alive)
    (folder / layout.LOCK).unlink()
    run = info(own, PENDULUM_TOM)
    assert usual([run]) == []
    assert dict(figures_of(run))["steps / s"] == "-"  # a fit takes no step: that is no speed of 0
    links = Links(store=str(own), port=8600, rerun_port=9090, key="key")
    set_links(links, monkeypatch)
    app = draw("live")
    assert not app.get("iframe")
    for run_id, path in ((PENDULUM_TOM, "/live/{}.rrd"), (SECOND, "/rrd/{}/run.rrd")):
        app.selectbox(key="recording").select(run_id).run()
        [frame] = app.get("iframe")
        [address] = parse_qs(urlsplit(frame.proto.src).query)["url"]
        assert urlsplit(address).path == path.format(run_id)


def test_a_click_on_a_runs_curve_leads_to_the_replay_nearest_to_it(store: Path) -> None:
    before, at = RunReader(store / ROAD_TOM).evaluation_steps()[-2:]
    app = draw("live")
    app.session_state[replay_link.CLICKED] = (ROAD_TOM, at - 1)  # as `remember` does
    app.run()
    assert before < at - 1
    address = f"(/replays?run={ROAD_TOM}&step={at})"
    assert any(address in words.value for words in app.markdown)


# The form


def form() -> AppTest:
    """The page after the form was opened."""
    app = draw("live")
    assert not app.text_input
    app.session_state[start.FOLD] = True  # as a click on its title does
    return app.run()


def test_the_form_writes_the_command(store: Path) -> None:
    app = form()
    app.selectbox(key="start env").select("hopper").run()
    app.session_state[start.FOLD] = False
    app.text_input(key="start seeds").input("0-1").run()
    app.text_input(key="start set sac.lr").input("0.001").run()
    assert "2" in app.button(key="start").label
    shown = next(code.value for code in app.code if "tom train" in code.value)
    assert shown.startswith("tom train --env hopper --learner tom --preset mended --seed 0")
    assert shown.endswith(f"--sac.lr=0.001 --store {store}")
    app.text_input(key="start set sac.discount").input("2").run()
    assert "discount" in app.error[0].value
    assert not [button for button in app.button if button.key == "start"]


def test_the_preset_is_the_learners_own_until_another_is_chosen() -> None:
    app = form()
    app.selectbox(key="start env").select("hopper").run()
    preset, learner = "start preset", "start learner"
    assert app.selectbox(key=preset).value == "mended"
    assert app.selectbox(key=learner).select("mle").run().selectbox(key=preset).value == "paper"
    app.selectbox(key=preset).select("smoke").run()
    assert app.selectbox(key=learner).select("tom").run().selectbox(key=preset).value == "smoke"
    assert not app.warning
    assert not app.exception


def test_the_form_offers_the_tasks_of_plugins_and_says_which_cannot_be_made(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def broken() -> Task:
        raise UserError("task broken cannot be made")

    monkeypatch.setitem(OTHERS, "swimmer", lambda: replace(ENVS["hopper"], name="swimmer"))
    monkeypatch.setitem(OTHERS, "broken", broken)
    app = form()
    app.selectbox(key="start env").select("swimmer").run()
    assert any("tom train --env swimmer " in code.value for code in app.code)
    app.selectbox(key="start env").select("broken").run()
    assert not app.exception
    assert "task broken cannot be made" in [error.value for error in app.error]


def test_trainings_that_have_ended_are_forgotten_and_those_that_run_are_not(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def ended(words: Sequence[str]) -> Started:
        begun = stand_in(words, "")
        begun.process.wait(TIMEOUT_S)
        return begun

    monkeypatch.setattr(trainings, "start", lambda words: stand_in(words, WAITING))
    app = form()
    app.button(key="start").click().run()
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
    assert app.run().error


@pytest.mark.parametrize(("host", "key"), [("0.0.0.0", "key"), ("::1", ""), ("::1", "another")])
def test_nothing_is_started_for_others_or_without_the_key(
    host: str, key: str, store: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    set_links(Links(store=str(store), host=host, key=key), monkeypatch)
    app = draw("live")
    app.session_state[start.FOLD] = True
    assert not app.run().button
