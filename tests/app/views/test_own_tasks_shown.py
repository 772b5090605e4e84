"""Runs in tasks that are not ours on the pages: robots from their own geometry, else curves."""

import shutil
import sys
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
import pytest
from common import change, present
from gymnasium.spaces import Box
from studio_pages import Show, array, draw, figures, in_buffer, map_of, on_one_buffer
from studio_runs import info

from app.data import buffer, replays
from app.scenes import solids
from app.servers import viewers
from tom.record import Store, layout
from tom.record.reader import RunReader
from tom.record.task_record import scene_of, task_of
from tom.training.presets import resolve
from tom.training.run import train

MUJOCO = ("Swimmer-v5", "Reacher-v5")
PENDULUM = "Pendulum-v1"
SMALL = {"steps": 320, "evaluation": {"every": 160, "episodes": 1}, "matmul": "default"}


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run in each task; the first one's under the name of a module that is not there."""
    path = tmp_path_factory.mktemp("own")
    for gym_id in (*MUJOCO, PENDULUM):
        config = resolve(f"gymnasium:{gym_id}", "mle", "smoke", SMALL)
        train(config, Store(path), gym_id)
    for gym_id in ("Swimmer-v5", PENDULUM):
        shutil.copytree(path / gym_id, path / f"absent-{gym_id}")
        run, absent = RunReader(path / f"absent-{gym_id}"), f"absent_module:{gym_id}"
        change(run.path / layout.CONFIG, env=absent, config=run.config["config"] | {"env": absent})
    return path


@pytest.fixture
def shown(trained: Path, show: Show) -> Path:
    show(trained)
    return trained


@pytest.mark.parametrize("run_id", [*MUJOCO, "absent-Swimmer-v5"])
def test_a_robot_is_drawn_from_the_run_folder_alone(shown: Path, run_id: str):
    run = RunReader(shown / run_id)
    replay = present(replays.load(run, 320, 0, 10))
    assert replay.has_scene
    assert replay.imagined is not None
    assert (replay.ghost is not None) == run_id.endswith("Swimmer-v5")
    driven = solids.robot_solids(replay.model, replay.real)
    assert np.isfinite(driven.position).all()
    assert np.ptp(driven.position, axis=0).max() > 1e-3  # it moves
    app = draw("replays", run=run_id)
    assert not any("observations of the episode" in str(part) for part in app.main)
    assert "absent_module" not in sys.modules
    recorded = present(viewers.episode(str(shown), run_id, 320, 0, 10))
    assert len(recorded) > 1000
    assert (shown / run_id / "run.rrd").stat().st_size > 1000


@pytest.mark.parametrize("run_id", [*MUJOCO, "absent-Swimmer-v5"])
def test_robots_stand_in_the_states_of_a_buffer(shown: Path, run_id: str):
    run = RunReader(shown / run_id)
    recorded, model = run.buffer()[0], scene_of(run)
    assert model is not None
    assert buffer.has_robot(info(shown, run_id))
    ended = np.zeros(len(recorded), bool)
    rows = buffer.windows(ended, [20, 120])
    qpos = buffer.poses(task_of(run), recorded, run.recorded().state, rows)
    robots = solids.robot_solids(model, qpos)
    assert len(robots.position) == 2
    assert np.isfinite(robots.floor)
    assert np.abs(robots.position[:, 0] - robots.position[:, 24]).max() > 1e-4
    assert map_of(in_buffer(run=run_id))["planes"]


@pytest.mark.parametrize("run_id", [PENDULUM, f"absent-{PENDULUM}"])
def test_without_a_robot_there_are_curves_and_no_empty_scene(shown: Path, run_id: str):
    run = RunReader(shown / run_id)
    replay = present(replays.load(run, 320, 0, 10))
    assert not replay.has_scene
    assert replay.dt == 0.05
    app = draw("replays", run=run_id, step="320", episode="1")
    assert not app.get("iframe")
    curves = next(f for f in figures(app) if len(f["data"]) == 6)  # three dimensions, twice
    assert array(curves["data"][0]["y"]) == pytest.approx(replay.episode.obs[:, 0])
    assert viewers.episode(str(shown), run_id, 320, 0, 10) is not None
    regions = in_buffer(run=run_id)
    assert not regions.get("iframe")
    moments = figures(regions)[-1]["data"]  # three dimensions of the heaviest and the lightest
    assert len(moments) >= 3 * 10
    assert len(array(moments[0]["y"])) == 25
    of_none = in_buffer(run=run_id, row="5", where="age 200..")
    assert of_none.dataframe[0].value.empty
    assert not any(len(figure["data"]) >= 3 * 10 for figure in figures(of_none))
    assert "absent_module" not in sys.modules


def test_code_of_the_users_is_named_in_a_terminal_alone(shown: Path):
    app = on_one_buffer(run="absent-Swimmer-v5")
    (typed,) = (code.value for code in app.code if code.value.startswith("tom weigh absent"))
    assert "--env absent_module:Swimmer-v5" in typed
    assert "weigh" not in [button.key for button in app.button]
    assert "weigh" in [button.key for button in on_one_buffer(run="Swimmer-v5").button]
    regions = in_buffer(run="absent-Swimmer-v5")
    assert any("tom brush absent" in said.value for said in regions.caption)
    assert "brush it" not in [button.key for button in regions.button]
    some = in_buffer(run="Swimmer-v5", where="age ..50")
    assert "brush it" in [button.key for button in some.button]
    for run, offered in (("absent-Swimmer-v5", False), ("Swimmer-v5", True)):
        of_a_row = in_buffer(run=run, row="5")
        assert ("why weigh" in [button.key for button in of_a_row.button]) == offered
    assert "absent_module" not in sys.modules


class Heat(gym.Env):
    """A temperature and a heater: one observation, one action."""

    observation_space = Box(-10.0, 10.0, (1,))
    action_space = Box(-1.0, 1.0, (1,))

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None):
        super().reset(seed=seed)
        self.now = self.np_random.uniform(-1, 1, 1).astype(np.float32)
        return self.now, {}

    def step(self, action: np.ndarray):
        self.now = np.asarray(0.9 * self.now + 0.5 * np.asarray(action), np.float32)
        return self.now, -float(abs(self.now[0])), False, False, {}


@pytest.mark.usefixtures("studio")
def test_the_buffers_map_of_a_task_of_one_observation(tmp_path: Path, show: Show) -> None:
    gym.register("Heat-v0", Heat, max_episode_steps=50)  # pyright: ignore[reportArgumentType]
    try:
        train(resolve("gymnasium:Heat-v0", "pmac", "smoke", SMALL), Store(tmp_path), "heat")
    finally:
        del gym.registry["Heat-v0"]
    show(tmp_path)
    for query in ({}, {"plane": "two"}, {"plane": "two", "across": "observation 1"}):
        [plane] = map_of(in_buffer(run="heat", **query))["planes"]
        assert plane["key"].startswith("two@" if query else "contrast@")
