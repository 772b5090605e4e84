"""Trainings on a CUDA GPU: on one made of the CPU, and with `pytest -m gpu` on a real one."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tom.events import Event
from tom.learners import LEARNER_NAMES
from tom.record import RunReader, Store
from tom.training.fleet import train_fleet
from tom.training.plan import Trial
from tom.training.resume import resume
from tom.training.run import Stop, train

pytestmark = pytest.mark.usefixtures("gpu")


def trial(learner: str, seed: int, **more: Any) -> Trial:
    settings = {"steps": 220, "fit_every": 10, "tom": {"warmup": 5}, "device": "cuda", **more}
    return Trial("inverted-pendulum", learner, seed, "smoke", settings)


def finished(found: list[RunReader | Exception]) -> list[RunReader]:
    runs = [run for run in found if isinstance(run, RunReader)]
    assert len(runs) == len(found), found
    assert {run.status.state for run in runs} == {"finished"}
    return runs


def assert_same_rows(first: RunReader, second: RunReader, tolerance: float) -> None:
    for name in ("obs", "action", "reward"):
        a, b = (getattr(run.buffer()[0], name) for run in (first, second))
        np.testing.assert_allclose(a, b, rtol=tolerance, atol=tolerance)


def test_every_learner_and_every_model_trains(tmp_path: Path):
    fleet = [
        *(trial(name, 0) for name in LEARNER_NAMES),
        trial("mle", 1, model={"kind": "ensemble"}),
        trial("vagram", 2, model={"kind": "linear"}),
        trial("tom", 3, model={"weights": "scale"}),
    ]
    finished(train_fleet(fleet, Store(tmp_path), rerun=False))


def test_a_member_of_a_fleet_is_the_one_trained_alone(tmp_path: Path):
    fleet = [trial("mle", 0), trial("tom", 0), trial("tom", 1)]
    found = finished(train_fleet(fleet, Store(tmp_path / "fleet"), rerun=False))
    for own, run in zip(fleet, found, strict=True):
        alone = train(own.config, Store(tmp_path / "alone"), own.run_id, rerun=False)
        assert_same_rows(run, alone, 1e-2)


def test_those_who_are_left_go_on_where_a_member_diverges(tmp_path: Path):
    fleet = [trial("mle", 0), trial("mle", 1, sac={"lr": 1e30}), trial("mle", 2)]
    found = train_fleet(fleet, Store(tmp_path), rerun=False)
    assert isinstance(found[1], Exception)
    finished([found[0], found[2]])


def test_a_fleet_goes_on_from_its_checkpoints_as_if_it_had_not_stopped(tmp_path: Path):
    fleet, store, stop = [trial("mle", 0), trial("tom", 0)], Store(tmp_path / "a"), Stop()

    def watch(event: Event) -> None:
        if event.env_step == 213 and not stop.asked:
            stop()

    train_fleet(fleet, store, False, [(watch,)] * 2, stop=stop)
    assert {run.status.state for run in store.runs()} == {"stopped"}
    resumed = finished(train_fleet(fleet, store, rerun=False))
    whole = finished(train_fleet(fleet, Store(tmp_path / "b"), rerun=False))
    for one, undisturbed in zip(resumed, whole, strict=True):
        assert_same_rows(one, undisturbed, 1e-3)


def test_a_run_is_given_more_steps_by_its_name(tmp_path: Path):
    store, own = Store(tmp_path), trial("tom", 0)
    train_fleet([own], store, rerun=False)
    assert resume(store, own.run_id, steps=230, rerun=False).status.env_step == 230
