"""Numbers that go wrong: named in status.json with the step and what to try.

The rule: a loss that is not finite ends the training with exit code 1; all else is a warning and
the training goes on. What was recorded until then stays either way.
"""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from faults import config, ended, one_line, tom, train_command

from tom.config import OnlineConfig, SacRecordingConfig, TomConfig
from tom.data.transitions import Transitions
from tom.envs import ENVS, task
from tom.errors import DivergedError
from tom.events import Metrics
from tom.learners.tom import occupancy_weights
from tom.policy.stored import UniformPolicy
from tom.record import RunReader, Store
from tom.training.resume import resume
from tom.training.run import train
from tom.training.watch import Watch

pytestmark = pytest.mark.fault


def ends(path: Path, learner: str = "mle", **changes: object) -> RunReader:
    """The record of a training that a number ended."""
    store = Store(path)
    with pytest.raises(DivergedError):
        train(config(learner, **changes), store, "a", rerun=False)  # pyright: ignore
    run = store.run("a")
    assert run.status.state == "failed"
    assert run.problems == []
    return run


def goes_on(path: Path, made: OnlineConfig) -> RunReader:
    run = train(made, Store(path), "a", rerun=False)
    assert run.status.state == "finished"
    return run


def warned(run: RunReader, words: str) -> str:
    """The one warning of the status with these words."""
    [found] = [text for text in run.status.warnings if words in text]
    assert found.startswith("step ")
    return found


@pytest.mark.quick
@pytest.mark.parametrize("learner", ["mle", "vagram-ensemble"])
def test_a_sac_loss_that_is_not_finite__ends_the_training_at_that_step_and_says_what_to_try(
    tmp_path: Path, learner: str
):
    run = ends(tmp_path, learner, sac={"lr": 1e20})
    assert run.status.reason.startswith("step 4")
    assert "try a lower --sac.lr" in run.status.reason
    assert len(run.metrics()) >= 1  # what was measured before


@pytest.mark.quick
def test_a_model_loss_that_is_nan__ends_the_training_at_that_fit_and_says_what_to_try(
    tmp_path: Path,
):
    run = ends(tmp_path, model={"lr": 1e20})
    assert run.status.reason == "step 40: model/train_nll is nan: try a lower --model.lr"
    assert run.metrics()["env_step"].tolist()[-1] == 40  # the row with the loss is recorded


def test_a_dual_loss_that_is_nan__ends_the_training_at_that_fit_and_says_what_to_try(
    tmp_path: Path,
):
    run = ends(tmp_path, "tom", tom={"q_lr": 1e20, "warmup": 1})
    assert run.status.reason.startswith("step 80: dual/loss is nan: try a lower --tom.q-lr")
    assert "uniform weights" in warned(
        run, "every weight is zero, or some weight is negative or not finite"
    )


def test_a_discriminator_that_explodes__ends_the_training_and_says_what_to_try(tmp_path: Path):
    run = ends(tmp_path, "tom", tom={"discriminator_lr": 1e20, "warmup": 1})
    assert "--tom.discriminator-lr" in run.status.reason


def test_a_sac_recording_whose_loss_is_not_finite__ends_at_that_step(tmp_path: Path):
    made = SacRecordingConfig(env="hopper", steps=80, exploration_steps=40).but(
        sac={"hidden": 16, "batch_size": 32, "lr": 1e20}
    )
    with pytest.raises(DivergedError, match=r"step 1\d\d: .*--sac.lr"):
        train(made, Store(tmp_path), "a", rerun=False)
    assert Store(tmp_path).run("a").status.state == "failed"


def test_a_loss_that_is_not_finite_on_the_command_line__exit_1_and_one_line(tmp_path: Path):
    command = train_command(tmp_path, sac={"lr": 1e20})
    code, _, error = ended(tom(*command, "--run-id", "a"))
    assert code == 1
    lines = error.strip().splitlines()
    assert "failed: step 4" in lines[-1]
    assert "Traceback" not in error


def test_all_weights_zero__that_fit_is_uniform_and_says_so(tmp_path: Path):
    # A dual whose Q is pushed far up at once: the argument of f*' is negative everywhere.
    made = config("tom", steps=120, tom={"q_lr": 30.0, "q_steps": 1, "warmup": 1, "discount": 0.0})
    run = goes_on(tmp_path, made)
    assert "uniform weights" in warned(run, "every weight is zero")
    np.testing.assert_array_equal(run.snapshot(run.snapshot_steps()[-1])["weight"], 1.0)


@pytest.mark.quick
def test_modelled_rollouts_that_explode__goes_on_and_says_so(tmp_path: Path):
    # A model that has seen one transition near the origin knows nothing of any scale.
    run = goes_on(tmp_path, config(steps=30, exploration_steps=1, fit_every=5))
    text = warned(run, "lead far outside the data")
    assert "try a lower --model.lr or shorter rollouts (--rollout.length" in text
    assert np.nanmax(run.metrics()["rollout/exploded"].to_numpy(float)) > 0.5


@pytest.mark.quick
def test_a_discriminator_that_separates_perfectly__weights_stay_finite_and_the_run_says_so():
    rng = np.random.default_rng(0)

    def rows(centre: float, n: int) -> Transitions:
        obs = rng.normal(centre, 0.1, (n, 3)).astype(np.float32)
        action, flags = rng.uniform(-1, 1, (n, 2)).astype(np.float32), np.zeros(n, bool)
        return Transitions(obs, action, np.zeros(n, np.float32), obs, flags, flags)

    replay, policy_rows = rows(0.0, 400), rows(50.0, 100)
    small = {"discriminator_hidden": 32, "q_hidden": 32}
    changes = {**small, "discriminator_steps": 60, "q_steps": 20, "discriminator_lr": 1e-2}
    found = occupancy_weights(
        replay,
        policy_rows,
        UniformPolicy(3, 2),
        np.asarray(replay.obs)[:10],
        TomConfig().but(**changes),
        torch.Generator().manual_seed(0),
    )
    assert found.metrics["discriminator/accuracy"] == 1.0
    assert torch.isfinite(found.weights).all()
    assert float(found.weights.mean()) == pytest.approx(1.0, abs=1e-4)
    [notice] = Watch(config("tom")).check(Metrics(80, found.metrics))
    assert notice.kind == "perfect-discriminator"
    assert "--tom.label-smoothing" in notice.message


def test_a_discriminator_without_a_mistake_in_a_run__goes_on_and_says_so(tmp_path: Path):
    # One step on one row of each kind, judged before it has learnt: right by luck.
    lucky = {"discriminator_batch": 1, "discriminator_steps": 1, "warmup": 1}
    run = goes_on(tmp_path, config("tom", tom=lucky))
    assert "--tom.label-smoothing" in warned(run, "without a mistake")
    assert np.isfinite(run.snapshot(run.snapshot_steps()[-1])["weight"]).all()


@pytest.mark.quick
def test_episodes_of_length_1__goes_on_and_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    # Hopper that counts as fallen unless its torso is ten metres up.
    falling = replace(
        task("hopper"),
        name="falling",
        kwargs={"healthy_z_range": (10.0, 11.0)},
        terminated=lambda obs: torch.ones(len(obs), dtype=torch.bool),
    )
    monkeypatch.setitem(ENVS, "falling", falling)
    run = goes_on(tmp_path, config(steps=80).but(env="falling"))
    assert "start states" in warned(run, "episodes ended after one step")
    assert run.buffer()[0].terminated.all()


def test_constant_observation_dimensions__goes_on_and_names_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    # Ant with the contact forces of all its bodies: most never touch anything.
    names = (*task("ant").obs_names, *(f"contact {i}" for i in range(78)))
    touching = replace(task("ant"), name="touching", kwargs={}, obs_names=names)
    monkeypatch.setitem(ENVS, "touching", touching)
    run = goes_on(tmp_path, config(steps=50).but(env="touching"))
    text = warned(run, "of 105 observation dimensions (")
    assert "leave them out" in text
    assert np.isfinite(run.metrics()["model/train_nll"].dropna()).all()


@pytest.mark.quick
@pytest.mark.parametrize("rows", [1, 5])
def test_a_buffer_smaller_than_a_batch__goes_on_with_replacement_and_says_so(
    tmp_path: Path, rows: int
):
    run = goes_on(tmp_path, config("tom", steps=30, exploration_steps=rows, fit_every=5))
    assert "--exploration-steps 64" in warned(run, f"holds {rows} rows at first")


def test_no_exploration_at_all__refused_in_one_line(tmp_path: Path):
    code, _, error = ended(tom(*train_command(tmp_path, exploration_steps=0)))
    assert code == 2
    assert "--exploration-steps 0: must be greater than or equal to 1" in one_line(error)
    assert not list(tmp_path.iterdir())


def test_a_warning_outlives_a_resume__it_is_said_once(tmp_path: Path):
    made = config(steps=60, exploration_steps=5, fit_every=5)
    train(made, Store(tmp_path), "a", rerun=False)
    run = resume(Store(tmp_path), "a", steps=100, rerun=False)
    assert sum(notice["kind"] == "small-buffer" for notice in run.notices()) == 1
