"""Replays: the episodes that were recorded, and what the run's own model makes of them."""

import shutil
from dataclasses import replace
from pathlib import Path
from urllib.parse import parse_qs, urljoin, urlsplit

import numpy as np
import pytest
import torch
from common import present
from streamlit.testing.v1 import AppTest
from studio_pages import Show, array, draw, figures, metrics, recorded, trace
from studio_runs import PENDULUM_TOM, ROAD_TOM

from app.data import replays
from app.data.replays import ROAD_DT, Replay
from app.figures.replay import episode_curves
from app.scenes import solids
from app.servers import viewers
from tom.analysis.imagine import stored_model
from tom.record import layout
from tom.record.reader import RunReader

RUNS = Path(__file__).parents[3] / "runs"

pytestmark = pytest.mark.usefixtures("studio")


@pytest.fixture
def run(store: Path) -> RunReader:
    return RunReader(store / PENDULUM_TOM)


def loaded(run: RunReader, step: int, horizon: int = 10) -> Replay:
    return present(replays.load(run, step, 0, horizon))


def test_a_replay_is_the_recorded_episode_and_a_ghost(run: RunReader) -> None:
    replay = loaded(run, 400)
    episode = run.episodes(400)[0]
    assert replay.real == pytest.approx(episode.qpos)
    assert replay.ghost is not None
    assert replay.ghost[0] == pytest.approx(replay.real[0], abs=1e-6)
    assert replay.model_step == 400
    assert replay.no_ghost == ""
    assert len(replay.error) == episode.length


def test_a_dimension_that_stands_still_has_no_part_in_the_distance(run: RunReader) -> None:
    whole = loaded(run, 400)
    still, off = np.zeros((len(whole.real), 1), np.float32), np.ones((len(whole.real), 1))
    more = with_states(whole, np.hstack([whole.episode.obs, still]), off)
    assert more.error == pytest.approx(whole.error)
    only = with_states(whole, still, off, alone=True)
    assert np.isnan(only.error).all()
    said = episode_curves(only, 0, 200).to_dict()["layout"]["annotations"]
    assert "no distance" in said[0]["text"]
    assert "annotations" not in episode_curves(whole, 0, 200).to_dict()["layout"]


def with_states(
    replay: Replay, obs: np.ndarray, beside: np.ndarray, *, alone: bool = False
) -> Replay:
    """The replay with other states, imagined as they were with `beside` as their last dimension."""
    assert replay.imagined is not None
    imagined = beside if alone else np.hstack([replay.imagined.obs, beside])
    return replace(
        replay,
        episode=replace(replay.episode, obs=obs),
        imagined=replace(replay.imagined, obs=imagined),
    )


def test_another_model_of_the_same_step_imagines_another_ghost(store: Path, tmp_path: Path) -> None:
    own = shutil.copytree(store / PENDULUM_TOM, tmp_path / PENDULUM_TOM)
    run = RunReader(own)
    before = loaded(run, 400)
    assert loaded(run, 400) is before  # kept, as nothing has changed
    shutil.rmtree(own / "checkpoint")
    shutil.copytree(store / "pendulum-tom-1" / "checkpoint", own / "checkpoint")
    after = loaded(run, 400)
    assert before.model_step == after.model_step == 400
    assert before.ghost is not None
    assert after.ghost is not None
    assert not np.array_equal(before.ghost, after.ghost)
    assert np.array_equal(before.real, after.real)


def test_road_and_rocks_is_replayed_on_its_map(store: Path) -> None:
    run = RunReader(store / ROAD_TOM)
    replay = loaded(run, run.evaluation_steps()[-1], 5)
    assert replay.road is not None
    assert replay.dt == ROAD_DT
    assert replay.ghost is not None
    _, following = stored_model(run).predictor.predict(*first_step(replay))
    assert replay.ghost[1] == pytest.approx(following[0].numpy(), abs=1e-6)
    driven = solids.robot_solids(replay.model, replay.real)
    assert driven.root[:, :2] == pytest.approx(replay.real, abs=0.01)


def first_step(replay: Replay) -> tuple[torch.Tensor, torch.Tensor]:
    episode = replay.episode
    return torch.from_numpy(episode.obs[:1]), torch.from_numpy(episode.action[:1])


def test_the_page_shows_the_chosen_episode(store: Path, run: RunReader) -> None:
    app = draw("replays", run=PENDULUM_TOM, episode="2", frame="3")
    episodes = run.episodes(400)
    values = metrics(app)
    assert values["return"] == f"{episodes[1].undiscounted_return:,.1f}"
    assert values["length"] == f"{episodes[1].length:,} steps"
    returns, rewards = figures(app)
    chosen = trace(returns, name="the one shown")
    assert array(chosen["x"]).tolist() == [400]
    assert array(chosen["y"]) == pytest.approx([episodes[1].undiscounted_return])
    assert chosen["meta"] == [2]
    curve = trace(returns, name="mean of the evaluation")
    steps, means = recorded(store, PENDULUM_TOM)
    assert array(curve["x"]).tolist() == steps
    assert array(curve["y"]) == pytest.approx(means)
    replay = present(replays.load(run, 400, 1, 25))
    assert array(trace(rewards, name="real")["y"])[:-1] == pytest.approx(episodes[1].reward)
    assert rewards["layout"]["shapes"][0]["x0"] == pytest.approx(3 * replay.dt)
    assert array(rewards["data"][-1]["y"])[1:] == pytest.approx(replay.error)


@pytest.fixture
def with_viewers(studio: None, store: Path, show: Show) -> None:
    show(store, port=8600, folder=str(store))


@pytest.mark.usefixtures("with_viewers")
def test_an_episode_is_shown_in_rerun_and_one_that_is_not_there_is_none(
    store: Path, run: RunReader
) -> None:
    app = draw("replays", run=PENDULUM_TOM, episode="2", ghost="10 steps", viewer="Rerun")
    assert asked_of_rerun(app) == f"/rrd/{PENDULUM_TOM}/episode-400-1-10.rrd"
    content = present(viewers.episode(str(store), PENDULUM_TOM, 400, 1, 10))
    assert content.startswith(b"RRF2")
    assert viewers.episode(str(store), PENDULUM_TOM, 400, 99, 25) is None
    assert viewers.episode(str(store), "../etc", 400, 0, 25) is None
    assert replays.load(run, 400, 99, 10) is None
    assert replays.load(run, 401, 0, 10) is None


def asked_of_rerun(app: AppTest) -> str:
    """The path of the recording that the page's only frame asks for."""
    [frame] = app.get("iframe")
    [address] = parse_qs(urlsplit(frame.proto.src).query)["url"]
    return urlsplit(urljoin(frame.proto.src, address)).path


def test_a_frame_of_a_longer_episode_is_forgotten() -> None:
    app = draw("replays", run=PENDULUM_TOM, step="400", frame="999", episode="77")
    assert app.slider[0].value == 0
    assert app.selectbox(key="episode").value == 1


def test_the_slider_stands_at_the_shown_step_also_in_an_episode_of_another_length(
    own: Path,
) -> None:
    path = own / PENDULUM_TOM / layout.episodes(400)
    with np.load(path) as file:
        arrays = {**file}
    for name, left in (("reward", 9), ("action", 9), ("obs", 10), ("qpos", 10), ("qvel", 10)):
        arrays[f"{name}_1"] = arrays[f"{name}_1"][:left]
    np.savez(path, allow_pickle=False, **arrays)
    app = draw("replays", run=PENDULUM_TOM, step="400", frame="3")
    assert app.slider[0].max > 9
    app.selectbox(key="episode").select(2).run()
    assert (app.slider[0].max, app.slider[0].value) == (9, 3)


def test_runs_stand_side_by_side_with_their_returns_and_weights(store: Path) -> None:
    chosen = [PENDULUM_TOM, "pendulum-mle-0"]
    app = draw("replays", task="inverted-pendulum", part="Side by side", side=chosen)
    assert app.multiselect(key="side").value == chosen
    [figure] = figures(app)
    lines = [line for line in figure["data"] if line["type"] == "scatter" and line.get("y")]
    for run_id in chosen:
        steps, means = recorded(store, run_id)
        assert any(
            array(line["x"]).tolist() == steps and array(line["y"]) == pytest.approx(means)
            for line in lines
        )
    maps = [line for line in figure["data"] if line["type"] == "heatmap"]
    for run_id, drawn in zip(chosen, maps, strict=True):
        profiles = RunReader(store / run_id).profiles()
        assert array(drawn["z"]).shape[::-1] == profiles.bins.shape
    app.multiselect(key="side").set_value(chosen[:1]).run()
    assert not figures(app)


def test_runs_that_keep_their_episodes_are_the_first_to_stand_side_by_side(show: Show) -> None:
    show(RUNS)
    chosen = draw("replays", task="hopper", part="Side by side").multiselect(key="side").value
    assert len(chosen) > 1
    assert all(RunReader(RUNS / run_id).evaluation_steps() for run_id in chosen)


def test_a_car_looks_where_it_drives() -> None:
    line = np.array([[0, 0], [0.1, 0], [0.1, 0.1]])
    car = solids.car(line)
    assert car.position[:, 0, :2] == pytest.approx(line)
    assert car.wxyz[1, 0] == pytest.approx([np.sqrt(0.5), 0, 0, np.sqrt(0.5)])
