"""The recording holds the right numbers; without it, or when it is slow, training goes on."""

import shutil
import threading
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from recorded import Config, events, logged, transitions
from rerun.chunk import RrdReader

from tom.config import RoadConfig
from tom.envs import scene
from tom.events import Collected, Episode, Evaluation, Field, Metrics, Weights
from tom.learners import LEARNERS
from tom.record import RunReader, Store
from tom.record.export import export
from tom.record.recorder import Recorder
from tom.record.rerun import sink
from tom.record.rerun.drawing import heat
from tom.record.rerun.feed import Follower
from tom.record.rerun.sink import RerunSink
from tom.record.rerun.view import episode_recording
from tom.record.writer import RunWriter

mj = scene._mj


@pytest.fixture(scope="module")
def hopper(tmp_path_factory: pytest.TempPathFactory) -> RunReader:
    """The small run, with real hopper positions in its episodes."""
    store = Store(tmp_path_factory.mktemp("store"))
    writer = RunWriter.create(store, "run", Config)
    with Recorder(writer, RerunSink(writer.path)) as recorder:
        for event in events():
            recorder.consume(_with_real_positions(event))
    run = store.run("run")
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


def test_the_robot_stands_where_mujoco_puts_it(hopper: RunReader):
    table = logged(hopper.rrd_files()[0], "scene/robot/capsules")
    # 9 positions 0.008 s apart at 30 frames a second: every fourth is drawn. They lie on the steps
    # before the evaluation, as there are none behind the last.
    assert table["env_step"].tolist() == [492, 496, 500, 992, 996, 1000]
    model = scene.model("hopper").mj
    data = mj.MjData(model)
    qpos = hopper.episodes(500)[0].qpos
    assert qpos is not None
    for drawn, frame in zip(table["Capsules3D:translations"], (0, 4, 8), strict=False):
        data.qpos[:] = qpos[frame]
        mj.mj_forward(model, data)
        for k, geom in enumerate(np.flatnonzero(model.geom_type == scene.CAPSULE)):
            axis = data.geom_xmat[geom].reshape(3, 3)[:, 2]
            end = data.geom_xpos[geom] - axis * model.geom_size[geom, 1]
            np.testing.assert_allclose(drawn[k], end, atol=1e-5)


def test_the_camera_follows_the_robot(hopper: RunReader):
    places = logged(hopper.rrd_files()[0], "scene/place")["Transform3D:translation"]
    np.testing.assert_allclose([p[0][0] for p in places][:3], [0.0, 0.2, 0.4], atol=1e-6)


PLACES = np.array([[0.1, 0.2], [0.3, 0.4], [0.5, 0.6], [0.7, 0.8]], np.float32)
LINE = np.array([[0.1, 0.1], [0.9, 0.1], [0.9, 0.9]])


@pytest.fixture(scope="module")
def road(tmp_path_factory: pytest.TempPathFactory) -> RunReader:
    """A fit of road-and-rocks: its data, weights, pictures and metrics."""
    store = Store(tmp_path_factory.mktemp("store"))
    config = RoadConfig(learner="tom", steps=10)
    writer = RunWriter.create(store, "road", config)
    rows = replace(transitions(0, 4), obs=PLACES)
    ground = {"centre_line": LINE, "road_half_width": np.array(0.1)}
    ground |= {"start": np.array([0.1, 0.1, 0.02]), "goal": np.array([0.9, 0.9, 0.07])}
    paths = {"expert_0": LINE, "learnt_0": LINE[::-1], "learnt_1": LINE}
    arrows = {"points": PLACES, "true": PLACES / 10, "modelled": -PLACES / 10}
    with Recorder(writer, RerunSink(writer.path)) as recorder:
        recorder.consume(Field(0, "map", ground))
        recorder.consume(Collected(0, rows, np.zeros(4, np.int64)))
        recorder.consume(Weights(5, np.array([0, 1, 1, 2], np.float32)))
        recorder.consume(Field(5, "model", arrows))
        recorder.consume(Field(5, "trajectories", paths))
        recorder.consume(Metrics(5, {"model/error_road": 0.25}))
    return store.run("road")


def test_road_and_rocks_is_a_map(road: RunReader):
    assert road.notices() == []
    [path] = road.rrd_files()
    drawn = logged(path, "map/learnt")["LineStrips2D:strips"].iloc[0]
    np.testing.assert_allclose(np.stack(drawn[0]), LINE[::-1] * [1, -1])
    assert len(drawn) == 2
    vectors = logged(path, "map/modelled")["Arrows2D:vectors"].iloc[0]
    np.testing.assert_allclose(np.stack(vectors), -PLACES / 10 * [1, -1], atol=1e-7)
    assert len(logged(path, "map/data")["Points2D:colors"].iloc[0]) == 4
    text = logged(path, "fit")["TextDocument:text"].iloc[0][0]
    assert "| model/error_road | 0.25 |" in text


def test_the_recording_of_a_resumed_run_has_what_is_new_and_the_places(
    road: RunReader, tmp_path: Path
):
    resumed = RerunSink(shutil.copytree(road.path, tmp_path / "road"))
    resumed.start(after=4)
    assert resumed.close() is None
    assert resumed.path.name == "run-2.rrd"
    assert len(logged(resumed.path, "map/data")["Points2D:colors"].iloc[-1]) == 4
    rows = held(resumed.path)
    assert rows["/map/data"] == 2  # the places, at all times, and the weights
    assert "/map/road" not in rows
    assert "/model/error_road" not in rows


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
    run = RunWriter.create(store, "road", RoadConfig(learner="tom", steps=10))
    run.close()
    path = tmp_path / "episode.rrd"
    path.write_bytes(episode_recording(store.run("road"), 10, episode, 0.1, places + 0.1))
    for name, moved in (("car", 0.0), ("ghost", 0.1)):
        drawn = np.array(logged(path, f"map/{name}")["Points2D:positions"].tolist())[:, 0]
        np.testing.assert_allclose(drawn, (places + moved) * [1, -1], atol=1e-6)


def test_weights_are_blue_below_the_mean_and_red_above():
    red, green, blue, _ = heat(np.array([0.0, 1.0, 100.0])).T.astype(int)
    assert blue[0] > red[0]
    assert red[1] == green[1] == blue[1]
    assert red[2] > blue[2]


def test_a_recording_that_cannot_be_written_costs_training_nothing(store: Store):
    writer = RunWriter.create(store, "run", Config)
    nowhere = RerunSink(writer.path)
    nowhere.path = store.path / "no" / "run.rrd"
    with Recorder(writer, nowhere) as recorder:
        for event in events():
            recorder.consume(event)
    run = store.run("run")
    assert run.status.state == "finished"
    assert len(run.metrics()) == 10
    assert run.notices()[-1]["code"] == "rerun"


def test_a_viewer_that_hangs_holds_the_end_of_a_run_up_for_a_moment_only(
    store: Store, monkeypatch: pytest.MonkeyPatch
):
    release = threading.Event()
    monkeypatch.setattr(sink, "CLOSE_S", 0.1)
    monkeypatch.setattr(Follower, "follow", lambda self: iter([release.wait()]))
    writer = RunWriter.create(store, "run", Config)
    with Recorder(writer, RerunSink(writer.path)):
        pass
    release.set()
    assert store.run("run").status.state == "finished"
    assert store.run("run").notices()[-1]["code"] == "rerun"
