"""A run's own model, playing the recorded actions of its evaluation episodes."""

import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor

from tom.analysis.imagine import imagine, joint_positions, stored_model
from tom.data.transitions import Transitions
from tom.envs import task
from tom.errors import UserError
from tom.events import Episode
from tom.exams.diagnostics import errors_of_rows
from tom.policy.collect import Evaluator
from tom.policy.stored import read_policy
from tom.record import RunReader, Store, checkpoint, layout
from tom.record.checkpoint import model_step
from tom.record.export import export_small
from tom.record.integrity import verify
from tom.road import task as road
from tom.training.presets import resolve
from tom.training.resume import resume
from tom.training.run import train


class Adder:
    """next_obs = obs + action; the reward is the action."""

    def predict(self, obs: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        return action[:, 0], obs + action


def straight(steps: int) -> Episode:
    """A line on which every step adds 10."""
    obs = 10 * np.arange(steps + 1, dtype=np.float32)[:, None]
    return Episode(reward=np.zeros(steps, np.float32), action=np.ones_like(obs[1:]), obs=obs)


@pytest.fixture(scope="module")
def hopper(tmp_path_factory: pytest.TempPathFactory) -> RunReader:
    config = resolve("hopper", "mle", "smoke", {"steps": 360, "matmul": "default"})
    return train(config, Store(tmp_path_factory.mktemp("store")), "hopper", rerun=False)


def test_the_model_starts_again_from_the_real_state():
    found = imagine(Adder(), straight(5), 2)
    assert found.obs[:, 0].tolist() == [0, 1, 2, 21, 22, 41]
    assert found.reward.tolist() == [1, 1, 1, 1, 1]
    assert imagine(Adder(), straight(5), 1).obs[:, 0].tolist() == [0, 1, 11, 21, 31, 41]
    assert imagine(Adder(), straight(5), 9).obs[:, 0].tolist() == [0, 1, 2, 3, 4, 5]


def test_a_model_that_runs_away_stays_where_it_was_finite():
    class Runaway(Adder):
        def predict(self, obs: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
            reward, following = super().predict(obs, action)
            return reward, torch.where(following > 2, torch.inf, following)

    assert imagine(Runaway(), straight(4), 4).obs[:, 0].tolist() == [0, 1, 2, 2, 2]


def test_errors_are_in_standard_deviations_of_a_steps_change():
    obs = np.zeros((4, 1), np.float32)
    action = np.zeros((4, 1), np.float32)
    following = np.array([[3], [-3], [3], [-3]], np.float32)
    nothing = np.zeros(4, np.float32)
    rows = Transitions(obs, action, nothing, following, nothing, nothing)
    assert errors_of_rows(Adder(), rows.torch()).numpy() == pytest.approx(1)


def test_the_kept_model_predicts_as_the_run_measured(hopper: RunReader):
    kept = stored_model(hopper)
    assert kept.env_step == 360
    rows, _ = hopper.buffer()
    errors = errors_of_rows(kept.predictor, rows.torch()).numpy()
    recorded = hopper.metrics()["model/error_other"].dropna().iloc[-1]
    assert np.sqrt(np.square(errors).mean()) == pytest.approx(recorded, rel=0.5)


@pytest.mark.parametrize("env", ["hopper", "ant", "inverted-pendulum"])
def test_the_place_on_the_ground_is_integrated_from_the_velocity(env: str):
    known = task(env)
    action = torch.full((1, known.action_dim), 0.3)
    episode = Evaluator(known, 1).run(lambda obs: action.expand(len(obs), -1), seed=3)[0]
    assert episode.qpos is not None
    dt = float(known.make().unwrapped.dt)  # pyright: ignore[reportAttributeAccessIssue]
    found = joint_positions(known, episode, episode.obs, dt, horizon=10)
    assert found[:, known.root_dims :] == pytest.approx(episode.qpos[:, known.root_dims :])
    travelled = np.abs(np.diff(episode.qpos[:, : known.root_dims], axis=0)).sum(0)
    off = np.abs(found - episode.qpos)[:, : known.root_dims].max(0, initial=0)
    assert (off <= 0.02 + 0.05 * travelled).all()
    assert (found[1:11, : known.root_dims] != episode.qpos[0, : known.root_dims]).all()


def test_a_road_runs_model_is_its_linear_one(tmp_path: Path):
    config = resolve(
        "road-and-rocks", "mle", "smoke", {"steps": 4, "fit_every": 4, "matmul": "default"}
    )
    run = train(config, Store(tmp_path), "road", rerun=False)
    model = stored_model(run).predictor
    field = run.field("model", 4)
    points, action = (torch.from_numpy(field[name]) for name in ("points", "action"))
    reward, following = model.predict(points, action)
    inside = ((following > 0) & (following < 1)).all(1)
    moved = (following - points)[inside].numpy()
    assert moved == pytest.approx(field["modelled"][inside.numpy()], abs=1e-5)
    assert reward == pytest.approx(road.reward(following))


def test_a_run_without_a_model_says_so(hopper: RunReader, tmp_path: Path):
    bare = shutil.copytree(hopper.path, tmp_path / "bare")
    shutil.rmtree(bare / "checkpoint")
    with pytest.raises(UserError, match="kept no dynamics model"):
        stored_model(RunReader(bare))


def test_a_small_copy_keeps_the_model_and_cannot_go_on(hopper: RunReader, tmp_path: Path):
    store = Store(tmp_path / "kept")
    small = RunReader(export_small(hopper, store.path, keep=("model", "policy")))
    assert model_step(small.path) == model_step(hopper.path) == 360
    episode = hopper.episodes(hopper.evaluation_steps()[-1])[0]
    obs, action = torch.from_numpy(episode.obs[:-1]), torch.from_numpy(episode.action)
    ours, theirs = (stored_model(run).predictor.predict(obs, action)[1] for run in (small, hopper))
    change = (theirs - obs).std(0)
    assert ((ours - theirs).abs() / change).mean() < 0.01
    held = checkpoint.load(small.path / layout.MODEL)
    assert held is not None
    net = held.state["training"]["model"]["net"]
    assert {part.dtype for part in net.values()} == {torch.float16}
    assert read_policy(small.path / "policy.npz").env == "hopper"
    assert verify(small) == []
    before = sorted(small.path.iterdir())
    with pytest.raises(UserError, match="small copy, which cannot be resumed"):
        resume(store, "hopper", steps=400)
    assert sorted(small.path.iterdir()) == before
