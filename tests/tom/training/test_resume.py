"""Resumed and uninterrupted training are the same to the last bit."""

from collections.abc import Iterator
from errno import ENOSPC
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from common import online, reloaded, stopping_at
from same_records import assert_same_record

from tom.analysis.weighing import load_policy
from tom.config import OnlineConfig, SacRecordingConfig
from tom.data.transitions import Transitions
from tom.envs import task
from tom.errors import UserError
from tom.events import Collected, Evaluation, Event, Field, Metrics, Tick, TrainedPolicy, Weights
from tom.learners import LEARNER_NAMES
from tom.policy.stored import StoredPolicy
from tom.record import Store
from tom.record.writer import RunWriter
from tom.training.presets import learners, resolve
from tom.training.resume import resume, unfinished
from tom.training.run import AnyConfig, Training, make_training, train

STEPS, STOP = 430, 347  # stops within an episode and between two fits


def smoke(env: str, learner: str, **changes: Any) -> OnlineConfig:
    return online(env, learner, {"steps": STEPS, "tom": {"warmup": 50}, **changes})


def until(events: Iterator[Event], step: int) -> list[Event]:
    """The events up to the end of environment step `step`."""
    seen = []
    for event in events:
        seen.append(event)
        if isinstance(event, Tick) and event.ends_step and event.env_step == step:
            return seen
    pytest.fail(f"no end of step {step}")


def collected(training: Training, events: list[Event]) -> Collected:
    """The rows that were handed over so far, as a run folder holds them."""
    parts = [e for e in events if isinstance(e, Collected)]
    if not parts:
        replay = getattr(training, "replay")  # noqa: B009
        return Collected(0, replay.transitions()[:0].numpy(), np.empty(0, np.int64))
    rows = Transitions.concatenate([p.transitions for p in parts])
    known = [p.behaviour for p in parts if p.behaviour is not None]
    behaviour = np.concatenate(known) if known else None
    return Collected(0, rows, np.concatenate([p.policy_version for p in parts]), {}, behaviour)


def assert_same_events(first: list[Event], second: list[Event]) -> None:
    assert len(first) == len(second)
    for a, b in zip(first, second, strict=True):
        assert type(a) is type(b)
        assert a.env_step == b.env_step
        if isinstance(a, Metrics) and isinstance(b, Metrics):
            np.testing.assert_equal(a.values, b.values)
        elif isinstance(a, Weights) and isinstance(b, Weights):
            np.testing.assert_equal(vars(a), vars(b))
        elif isinstance(a, Evaluation) and isinstance(b, Evaluation):
            for x, y in zip(a.episodes, b.episodes, strict=True):
                np.testing.assert_array_equal(x.obs, y.obs)
        elif isinstance(a, Collected) and isinstance(b, Collected):
            np.testing.assert_array_equal(a.transitions.numpy().obs, b.transitions.numpy().obs)
            np.testing.assert_array_equal(a.policy_version, b.policy_version)
            np.testing.assert_equal(dict(a.state), dict(b.state))
            np.testing.assert_array_equal(a.behaviour, b.behaviour)
        elif isinstance(a, Field | TrainedPolicy) and isinstance(b, Field | TrainedPolicy):
            np.testing.assert_equal(a.arrays, b.arrays)


def assert_same_state(a: Any, b: Any, where: str = "") -> None:
    """Networks, optimisers, generators, buffers, scales, the simulator: all of it, bit for bit."""
    assert type(a) is type(b), where
    if isinstance(a, torch.Tensor):
        assert torch.equal(a.nan_to_num(), b.nan_to_num()), where
    elif isinstance(a, dict):
        assert a.keys() == b.keys(), where
        for name in a.keys() - {"action_random"}:  # nobody draws from it, so nobody seeds it
            assert_same_state(a[name], b[name], f"{where}/{name}")
    elif isinstance(a, list | tuple):
        assert len(a) == len(b), where
        for i, (x, y) in enumerate(zip(a, b, strict=True)):
            assert_same_state(x, y, f"{where}/{i}")
    else:
        assert a == b, where


def check(config: AnyConfig, stop: int, in_episode: bool = True) -> None:
    """Stopped after `stop` steps and taken up by a new process's objects: the same to the end."""
    training = make_training(config)
    events = training.events()
    before = until(events, stop)
    if in_episode:
        assert getattr(training, "_episode_length", 1) > 0, "stopped between two episodes"
        assert getattr(training, "_obs", True) is not None, "stopped between two episodes"
    state = reloaded(training.state_dict())
    undisturbed = list(events)

    resumed = make_training(config)
    resumed.load_state_dict(state, collected(training, before))
    assert_same_state(state, reloaded(resumed.state_dict()))
    assert_same_events(undisturbed, list(resumed.events()))
    assert_same_state(training.state_dict(), resumed.state_dict())


SOON = {
    "pdml": {"pdml": {"warmup": 50, "rows_per_policy": 40}},
    "policy-distance": {"policy_distance": {"warmup": 50}},
}
"""settings by which learners have weights before the stop"""


@pytest.mark.parametrize("learner", LEARNER_NAMES)
@pytest.mark.parametrize(
    "env", [pytest.param("hopper", marks=pytest.mark.slow), "inverted-pendulum"]
)
def test_resumed_equals_uninterrupted_in_the_middle_of_an_episode(env: str, learner: str):
    check(smoke(env, learner, **SOON.get(learner, {})), STOP)


@pytest.mark.parametrize(
    "env",
    [
        "Pendulum-v1",
        *(
            pytest.param(env, marks=pytest.mark.slow)
            for env in ("Swimmer-v5", "Reacher-v5", "Pusher-v5", "MountainCarContinuous-v0")
        ),
    ],
)
def test_a_gymnasium_task_goes_on_in_the_middle_of_an_episode(env: str):
    check(smoke(f"gymnasium:{env}", "tom"), STOP)


@pytest.mark.slow
def test_learnt_ends_go_on():
    check(smoke("hopper", "tom", model={"termination": "learnt"}), STOP)


@pytest.mark.slow
def test_a_run_whose_rollouts_grow_goes_on():
    rollout = {"final_length": 4, "schedule_start": 0, "schedule_end": 1}
    check(smoke("inverted-pendulum", "mle", rollout=rollout), STOP, in_episode=False)


def test_a_run_stopped_while_exploring_goes_on():
    check(smoke("hopper", "mle"), 37)


@pytest.mark.slow
@pytest.mark.parametrize("stop", [37, 60, 150, STOP])
def test_a_run_whose_buffer_holds_less_than_its_exploration_goes_on(stop: int):
    """At step 60 the buffer is full of rows that are not recorded yet."""
    config = smoke("gymnasium:Reacher-v5", "tom", replay_capacity=60)
    check(config, stop, in_episode=stop != 150)


@pytest.mark.parametrize(
    "learner",
    [
        pytest.param(name, marks=() if name == "tom" else pytest.mark.slow)
        for name in LEARNER_NAMES
        if name in learners("road-and-rocks")
    ],
)
def test_road_and_rocks_resumed_equals_uninterrupted(learner: str):
    check(road(learner, 250), 123, in_episode=False)


def road(learner: str, steps: int) -> AnyConfig:
    quick = {"q_steps": 50, "discriminator_steps": 50}
    given = {"steps": steps, "fit_every": 100, "random_transitions": 2000, "tom": quick}
    return resolve("road-and-rocks", learner, "smoke", given)


@pytest.mark.parametrize("stop", [70, 100, 100 + 83])
def test_a_recording_of_sac_goes_on_in_either_half(stop: int):
    small = {"hidden": 16, "batch_size": 32}
    config = SacRecordingConfig(env="hopper", steps=100, exploration_steps=40).but(
        sac=small, evaluation={"every": 60, "episodes": 1}
    )
    check(config, stop)


def short() -> OnlineConfig:
    every = {"checkpoint_every": 100, "fit_every": 50, "evaluation": {"every": 100, "episodes": 1}}
    return smoke("inverted-pendulum", "mle", exploration_steps=100, **{"steps": 200}, **every)


def test_a_run_that_ended_between_its_last_checkpoint_and_its_end_goes_on_to_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    arrays = RunWriter.arrays

    def full(self: RunWriter, name: str, content: object, **more: object) -> None:
        if name == "policy.npz":  # the last file of a training
            raise OSError(ENOSPC, "No space left on device")
        arrays(self, name, content, **more)  # pyright: ignore[reportArgumentType]

    store = Store(tmp_path)
    undisturbed = train(short(), store, "undisturbed", rerun=False)
    with monkeypatch.context() as patched:
        patched.setattr(RunWriter, "arrays", full)
        with pytest.raises(OSError, match="No space"):
            train(short(), store, "a", rerun=False)
    assert "tom train --resume a" in store.run("a").status.reason
    assert unfinished(store, short()) == "a"
    done = resume(store, "a", rerun=False)
    assert done.status.state == "finished"
    assert done.has_policy()
    assert_same_record(undisturbed, done)
    assert unfinished(store, short()) is None
    with pytest.raises(UserError, match="is complete at step 200"):
        resume(store, "a", rerun=False)


def test_a_run_that_goes_on_has_no_last_policy_until_it_has_ended_again(tmp_path: Path):
    store, known = Store(tmp_path), task("inverted-pendulum")
    stop, watchers = stopping_at(270)
    first = train(short(), store, "a", rerun=False)
    before = load_policy("a", store, known)
    assert first.has_policy()
    resume(store, "a", 300, rerun=False, watchers=watchers, stop=stop)
    assert not store.run("a").has_policy()
    kept = ", ".join(map(str, store.run("a").policy_steps()))
    with pytest.raises(UserError, match=f"kept no policy of its end: --step takes one of {kept}"):
        load_policy("a", store, known)
    assert resume(store, "a", rerun=False).has_policy()
    after = load_policy("a", store, known)
    assert isinstance(before, StoredPolicy)
    assert isinstance(after, StoredPolicy)
    obs = torch.zeros(1, known.obs_dim)
    assert not torch.equal(before.mean(obs), after.mean(obs))
