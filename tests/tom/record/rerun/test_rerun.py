"""The recording holds the right numbers; without it, or when it is slow, training goes on."""

import json
import os
import re
import shutil
import threading
from collections import Counter
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from common import change, present, recorded
from kernel import descendants
from recorded import Config, events, logged, transitions
from rerun.chunk import RrdReader

from tom.config import RoadConfig
from tom.envs import scene
from tom.events import Collected, Episode, Evaluation, Field, Metrics, Weights
from tom.learners import LEARNERS
from tom.record import RunReader, Store
from tom.record.export import export
from tom.record.recorder import Recorder
from tom.record.rerun import sink, viewer
from tom.record.rerun.feed import Follower, Tail, stream
from tom.record.rerun.sink import RerunSink
from tom.record.rerun.view import episode_recording
from tom.record.writer import RunWriter


@pytest.fixture(scope="module")
def hopper(tmp_path_factory: pytest.TempPathFactory) -> RunReader:
    """The small run, with real hopper positions in its episodes."""
    store = Store(tmp_path_factory.mktemp("store"))
    told = map(_with_real_positions, events())
    run = recorded(store, "run", Config, told, RerunSink(store.path / "run"))
    assert run.notices()[-1]["code"] != "rerun", run.notices()[-1]
    return run


def _with_real_positions(event):
    if not isinstance(event, Evaluation):
        return event
    qpos = scene.model("hopper").mj.qpos0 + np.arange(9)[:, None] * 0.05
    reward, wide = np.ones(8, np.float32), np.zeros((9, 1), np.float32)
    return Evaluation(event.env_step, [Episode(reward, wide[1:], wide, qpos.astype(np.float32))])


def test_metrics_are_scalars_over_env_steps(hopper: RunReader):
    [path] = hopper.rrd_files()
    for name in ("model/holdout_nll", "eval/return_max"):
        table = logged(path, name)
        want = hopper.metrics()[["env_step", name]].dropna()
        assert table["env_step"].tolist() == want["env_step"].tolist()
        np.testing.assert_allclose([v[0] for v in table["Scalars:scalars"]], want[name])
    assert logged(path, "critic/q").empty  # infinite in every row


def test_the_profile_is_bars(hopper: RunReader):
    table = logged(hopper.rrd_files()[0], "weights/profile")
    assert table["env_step"].tolist() == hopper.profiles().env_step.tolist()
    bars = table["BarChart:values"].iloc[1][0]["buffer"]
    np.testing.assert_allclose(bars, hopper.profiles().bins[1])
    colour = int((LEARNERS[hopper.learner].colour or "")[1:] + "ff", 16)
    assert table["BarChart:color"].iloc[1] == [colour]


def test_the_robot_stands_as_in_the_episode(hopper: RunReader):
    table = logged(hopper.rrd_files()[0], "scene/robot/capsules")
    # 9 positions 0.008 s apart at 30 frames a second: every fourth is drawn. They lie on the steps
    # before the evaluation, as there are none behind the last.
    assert table["env_step"].tolist() == [492, 496, 500, 992, 996, 1000]
    qpos = present(hopper.episodes(500)[0].qpos)[::4]
    ends = scene.geometry(scene.model("hopper").mj, qpos).capsules.capsule_end
    drawn = np.array(table["Capsules3D:translations"].tolist()[:3])
    np.testing.assert_allclose(drawn, ends, atol=1e-5)


def test_the_camera_follows_the_robot(hopper: RunReader):
    places = logged(hopper.rrd_files()[0], "scene/place")["Transform3D:translation"]
    np.testing.assert_allclose([p[0][0] for p in places][:3], [0.0, 0.2, 0.4], atol=1e-6)


@pytest.fixture(scope="module")
def road(tmp_path_factory: pytest.TempPathFactory) -> RunReader:
    """A fit of road-and-rocks: its data, weights and metrics."""
    store = Store(tmp_path_factory.mktemp("store"))
    told = [
        Collected(0, transitions(0, 4), np.zeros(4, np.int64)),
        Weights(5, np.array([0, 1, 1, 2], np.float32)),
        Metrics(5, {"model/error_road": 0.25}),
    ]
    config = RoadConfig(learner="tom", steps=10)
    return recorded(store, "road", config, told, RerunSink(store.path / "road"))


def test_the_recording_of_a_resumed_run_has_what_is_new(hopper: RunReader, tmp_path: Path):
    resumed = RerunSink(shutil.copytree(hopper.path, tmp_path / "run"))
    resumed.start(after=500)
    assert resumed.close() is None
    assert resumed.path.name == "run-2.rrd"
    rows = held(resumed.path)
    assert rows["/scene/place"] == held(hopper.rrd_files()[0])["/scene/place"] / 2
    assert "/model/holdout_nll" not in rows


def held(path: Path) -> Counter[str]:
    """How many rows a recording holds of each entity."""
    rows = Counter[str]()
    for chunk in RrdReader(path).stream():
        rows[chunk.entity_path] += chunk.num_rows
    return rows


@pytest.mark.parametrize("name", ["hopper", "road"])
def test_a_recording_made_from_the_files_is_the_trainings_own(
    name: str, tmp_path: Path, request: pytest.FixtureRequest
):
    run = request.getfixturevalue(name)
    [own] = run.rrd_files()
    assert held(export(run, "rrd", tmp_path)) == held(own)


def test_an_episode_is_a_recording_of_its_own(hopper: RunReader, tmp_path: Path):
    [episode] = hopper.episodes(500)
    assert episode.qpos is not None
    ghost = episode.qpos.copy()
    ghost[:, 0] += 0.5
    path = tmp_path / "episode.rrd"
    path.write_bytes(episode_recording(hopper, 500, episode, 0.25, ghost))
    reward = logged(path, "reward")
    assert reward["env_step"].tolist() == list(range(492, 500))  # and none behind step 500
    assert [pd.Timedelta(at).total_seconds() for at in reward["replay"]] == [
        0.25 * i for i in range(8)
    ]
    np.testing.assert_array_equal([v[0] for v in reward["Scalars:scalars"]], episode.reward)
    real, imagined = (
        np.array(logged(path, f"scene/{name}/capsules")["Capsules3D:translations"].tolist())
        for name in ("robot", "ghost")
    )
    assert real.shape[0] == 3  # every fourth of 9 positions, as in the run's own recording
    np.testing.assert_allclose(imagined - real, np.broadcast_to([0.5, 0, 0], real.shape), atol=1e-5)


def test_a_road_episode_is_a_car_on_its_map(store: Store, tmp_path: Path):
    places = np.array([(0.1, 0.2), (0.2, 0.3), (0.3, 0.5)], np.float32)
    episode = Episode(np.ones(2, np.float32), places[1:], places)
    line = np.array([[0.1, 0.1], [0.9, 0.1], [0.9, 0.9]])
    ground = {"centre_line": line, "road_half_width": np.array(0.1)}
    ground |= {"start": np.array([0.1, 0.1, 0.02]), "goal": np.array([0.9, 0.9, 0.07])}
    recorded(store, "road", RoadConfig(learner="tom", steps=10), [Field(0, "map", ground)])
    path = tmp_path / "episode.rrd"
    path.write_bytes(episode_recording(store.run("road"), 10, episode, 0.1, places + 0.1))
    for name, moved in (("car", 0.0), ("ghost", 0.1)):
        drawn = np.array(logged(path, f"map/{name}")["Points2D:positions"].tolist())[:, 0]
        np.testing.assert_allclose(drawn, (places + moved) * [1, -1], atol=1e-6)
    assert held(path)["/map/road"] == 1


def test_a_recording_that_cannot_be_written_costs_training_nothing(store: Store):
    nowhere = RerunSink(store.path / "run")
    nowhere.path = store.path / "no" / "run.rrd"
    run = recorded(store, "run", Config, events(), nowhere)
    assert run.status.state == "finished"
    assert len(run.metrics()) == 10
    assert run.notices()[-1]["code"] == "rerun"


def test_a_viewer_that_hangs_holds_the_end_of_a_run_up_for_a_moment_only(
    store: Store, monkeypatch: pytest.MonkeyPatch
):
    release = threading.Event()
    monkeypatch.setattr(sink, "CLOSE_S", 0.1)
    monkeypatch.setattr(Follower, "follow", lambda self: iter([release.wait()]))
    run = recorded(store, "run", Config, [], RerunSink(store.path / "run"))
    release.set()
    assert run.status.state == "finished"
    assert run.notices()[-1]["code"] == "rerun"


# Viewers get what running runs write, whenever they come


def rows(parts: Iterable[bytes], folder: Path, of: str) -> pd.DataFrame:
    """What a viewer is sent of one entity; each part is a file of its own."""
    found = [pd.DataFrame({"env_step": []})]
    for part in filter(None, parts):
        (folder / "part.rrd").write_bytes(part)
        found.append(logged(folder / "part.rrd", of))
    return pd.concat(found)


def test_a_stream_grows_with_the_run_and_ends_with_it(store: Store, tmp_path: Path):
    recorder = Recorder(RunWriter.create(store, "run", Config))
    given = events()
    for event in given[:600]:
        recorder.consume(event)
    parts = stream(store.run("run"))
    begun = store.run("run").profiles().env_step.tolist()
    got: list[int] = []
    while got != begun:
        got += rows([next(parts)], tmp_path, "weights/profile")["env_step"].tolist()
    for event in given[600:]:
        recorder.consume(event)
    recorder.finish("finished")
    got += rows(parts, tmp_path, "weights/profile")["env_step"].tolist()
    assert got == store.run("run").profiles().env_step.tolist() != begun


def test_of_a_run_that_has_nothing_yet_the_layout_is_streamed(record):
    pieces = list(Follower(record(given=[])).pieces())
    assert [piece[:4] for piece in pieces] == [b"RRF2"]


def test_a_viewer_that_comes_late_gets_many_rows_in_one_chunk(record, tmp_path: Path):
    run = record(given=[Metrics(step, {"model/train_nll": 1.0 / step}) for step in range(1, 201)])
    (tmp_path / "run.rrd").write_bytes(b"".join(stream(run)))
    chunks = [
        chunk.to_record_batch()
        for chunk in RrdReader(tmp_path / "run.rrd").stream()
        if chunk.entity_path == "/model/train_nll"
    ]
    assert [chunk.num_rows for chunk in chunks] == [200]


def test_a_tail_gives_each_whole_row_once(tmp_path: Path):
    path = tmp_path / "m"
    tail = Tail(path)
    assert tail.rows() == []
    path.write_bytes(b'{"env_step":1}\n{"env_st')
    assert tail.rows() == [{"env_step": 1}]
    assert tail.rows() == []
    with path.open("ab") as file:
        file.write(b'ep":2}\nrubbish\n{"env_step":3}\n')
    assert tail.rows() == [{"env_step": 2}, {"env_step": 3}]


def test_a_file_that_was_cut_is_read_from_its_beginning(tmp_path: Path):
    path = tmp_path / "m"
    path.write_text('{"env_step":1}\n{"env_step":2}\n{"env_step":3}\n')
    tail = Tail(path)
    assert len(tail.rows()) == 3
    path.write_text('{"env_step":1}\n{"env_step":2}\n')  # resumed from step 2
    assert tail.rows() == [{"env_step": 1}, {"env_step": 2}]


@pytest.mark.fault
@pytest.mark.quick
def test_a_run_of_an_environment_that_nobody_knows__is_shown_but_for_its_robot(record):
    run = record()
    settings = run.config["config"] | {"env": "nosuch"}
    change(run.path / "config.json", env="nosuch", config=settings)
    assert sum(map(len, stream(RunReader(run.path)))) > 10_000


# The viewer's files: a page that stays local, and no server left behind


def test_the_page_asks_no_other_host():
    page = b"""<html><head>
      <link rel="preconnect" href="https://fonts.gstatic.com" crossorigin />
      <link
        href="https://fonts.googleapis.com/css2?family=Inter" rel="stylesheet" />
      <link rel="icon" href="favicon.ico" /></head></html>"""
    local = viewer.local_page(page)
    assert b"fonts." not in local
    assert b"favicon.ico" in local
    assert local.index(b"window.fetch =") < local.index(b"favicon.ico")


def test_the_viewer_is_unpacked_and_leaves_no_server_of_reruns(tmp_path: Path):
    before = descendants(os.getpid())
    viewer.unpack(tmp_path / "rerun")
    assert {path.name for path in (tmp_path / "rerun").iterdir()} == set(viewer.FILES)
    page = (tmp_path / "rerun" / viewer.PAGE).read_bytes()
    assert b"googleapis" not in page
    assert re.search(rb"<script>.*window.fetch = .*</script>", page, re.DOTALL)
    assert (tmp_path / "rerun" / "re_viewer_bg.wasm").read_bytes().startswith(b"\0asm")
    assert [path.name for path in tmp_path.iterdir()] == ["rerun"]
    assert descendants(os.getpid()) <= before


def test_rerun_sends_no_statistics(tmp_path: Path):
    settings = Path(viewer.without_analytics(tmp_path)["XDG_CONFIG_HOME"]) / "rerun"
    assert json.loads((settings / "analytics.json").read_text())["analytics_enabled"] is False
