"""Numbers that go wrong: named in status.json with the step and what to try.

The rule: a loss that is not finite ends the training with exit code 1; all else is a warning and
the training goes on. What was recorded until then stays either way.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from faults import config, ended, one_line, tom, train_command

from tom.config import OnlineConfig, SacRecordingConfig
from tom.envs import ENVS, task
from tom.errors import DivergedError
from tom.record import RunReader, Store
from tom.training.resume import resume
from tom.training.run import train

pytestmark = pytest.mark.fault


def warned(path: Path, made: OnlineConfig, kind: str) -> RunReader:
    """The record of a training that ends well and with one warning of this kind."""
    run = train(made, Store(path), "a", rerun=False)
    assert run.status.state == "finished"
    [notice] = [notice for notice in run.notices() if notice["code"] == kind]
    assert f"step {notice['env_step']}: {notice['message']}" in run.status.warnings
    return run


@pytest.mark.quick
@pytest.mark.parametrize(
    ("learner", "changes", "step", "option"),
    [
        ("mle", {"sac": {"lr": 1e20}}, 4, "--sac.lr"),
        ("mle", {"model": {"lr": 1e20}}, 40, "--model.lr"),
        ("tom", {"tom": {"q_lr": 1e20, "warmup": 1}}, 80, "--tom.q-lr"),
        ("tom", {"tom": {"discriminator_lr": 1e20, "warmup": 1}}, 80, "--tom.discriminator-lr"),
    ],
)
def test_a_loss_that_is_not_finite__ends_the_training_at_that_step_and_says_what_to_try(
    tmp_path: Path, learner: str, changes: dict[str, Any], step: int, option: str
):
    with pytest.raises(DivergedError):
        train(config(learner, **changes), Store(tmp_path), "a", rerun=False)
    run = Store(tmp_path).run("a")
    assert run.status.state == "failed"
    assert run.status.reason.startswith(f"step {step}")
    assert option in run.status.reason
    assert len(run.metrics()) >= 1  # what was measured before
    assert run.problems == []


def test_a_sac_recording_whose_loss_is_not_finite__ends_at_that_step(tmp_path: Path):
    made = SacRecordingConfig(env="hopper", steps=80, exploration_steps=40).but(
        sac={"hidden": 16, "batch_size": 32, "lr": 1e20}
    )
    with pytest.raises(DivergedError, match=r"step 1\d\d: .*--sac.lr"):
        train(made, Store(tmp_path), "a", rerun=False)
    assert Store(tmp_path).run("a").status.state == "failed"


@pytest.mark.quick
def test_modelled_rollouts_that_explode__goes_on_and_says_so(tmp_path: Path):
    # A model that has seen one transition near the origin knows nothing of any scale.
    made = config(steps=30, exploration_steps=1, fit_every=5)
    run = warned(tmp_path, made, "rollout-exploded")
    assert np.nanmax(run.metrics()["rollout/exploded"].to_numpy(float)) > 0.5


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
    run = warned(tmp_path, config(steps=80).but(env="falling"), "short-episodes")
    assert run.buffer()[0].terminated.all()


def test_constant_observation_dimensions__goes_on_and_names_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    # Ant with the contact forces of all its bodies: most never touch anything.
    names = (*task("ant").obs_names, *(f"contact {i}" for i in range(78)))
    touching = replace(task("ant"), name="touching", kwargs={}, obs_names=names)
    monkeypatch.setitem(ENVS, "touching", touching)
    run = warned(tmp_path, config(steps=100).but(env="touching"), "constant-dimension")
    assert np.isfinite(run.metrics()["model/train_nll"].dropna()).all()


@pytest.mark.quick
@pytest.mark.parametrize("rows", [1, 5])
def test_a_buffer_smaller_than_a_batch__goes_on_with_replacement_and_says_so(
    tmp_path: Path, rows: int
):
    made = config("tom", steps=30, exploration_steps=rows, fit_every=5)
    warned(tmp_path, made, "small-buffer")


def test_no_exploration_at_all__refused_in_one_line(tmp_path: Path):
    code, _, error = ended(tom(*train_command(tmp_path, exploration_steps=0)))
    assert code == 2
    assert "--exploration-steps" in one_line(error)
    assert not list(tmp_path.iterdir())


def test_a_warning_outlives_a_resume__and_comes_once(tmp_path: Path):
    made = config(steps=60, exploration_steps=5, fit_every=5)
    train(made, Store(tmp_path), "a", rerun=False)
    run = resume(Store(tmp_path), "a", steps=100, rerun=False)
    assert sum(notice["code"] == "small-buffer" for notice in run.notices()) == 1
