"""Resumed and uninterrupted training are the same to the last bit."""

import shutil
from collections.abc import Iterator, Mapping
from dataclasses import is_dataclass
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
from tom.events import Collected, Event, Tick
from tom.learners import LEARNERS
from tom.policy.stored import StoredPolicy
from tom.record import RunReader, Store
from tom.record.writer import RunWriter
from tom.training.presets import learners, resolve
from tom.training.resume import find_unfinished, resume
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


def assert_same(a: Any, b: Any, where: str = "") -> None:
    """Events, networks, optimisers, generators, buffers, scales, the simulator: bit for bit."""
    assert type(a) is type(b), where
    if isinstance(a, torch.Tensor):
        assert torch.equal(a.nan_to_num(), b.nan_to_num()), where
    elif is_dataclass(a):
        assert_same(vars(a), vars(b), where)
    elif isinstance(a, Mapping):
        assert a.keys() == b.keys(), where
        for name in a.keys() - {"action_random"}:  # nobody draws from it, so nobody seeds it
            assert_same(a[name], b[name], f"{where}/{name}")
    elif isinstance(a, list | tuple):
        assert len(a) == len(b), where
        for i, (x, y) in enumerate(zip(a, b, strict=True)):
            assert_same(x, y, f"{where}/{i}")
    else:
        np.testing.assert_equal(a, b, where)


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
    assert_same(state, reloaded(resumed.state_dict()))
    assert_same(undisturbed, list(resumed.events()))
    assert_same(training.state_dict(), resumed.state_dict())


SOON = {
    "pdml": {"pdml": {"warmup": 50, "rows_per_policy": 40}},
    "policy-distance": {"policy_distance": {"warmup": 50}},
}
"""settings by which learners have weights before the stop"""


@pytest.mark.parametrize("learner", LEARNERS)
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
        for name in LEARNERS
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
    assert find_unfinished(store, short()) == "a"
    done = resume(store, "a", rerun=False)
    assert done.status.state == "finished"
    assert done.has_policy()
    assert_same_record(undisturbed, done)
    assert find_unfinished(store, short()) is None
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


# The folder of a run that was stopped and resumed is that of one that was never interrupted


def kept(**changes: object) -> OnlineConfig:
    return smoke("hopper", "tom", checkpoint_every=100, **changes)


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> RunReader:
    store = Store(tmp_path_factory.mktemp("undisturbed"))
    return train(kept(), store, "whole", rerun=False)


def test_stopped_and_resumed_is_the_run_that_was_never_interrupted(undisturbed, tmp_path: Path):
    store = Store(tmp_path)
    stop, watchers = stopping_at(STOP)
    stopped = train(kept(), store, "a", rerun=False, watchers=watchers, stop=stop)
    assert stopped.status.state == "stopped"
    assert stopped.status.env_step == STOP
    assert "--resume a" in stopped.status.reason
    resumed = resume(store, "a", rerun=False, command="tom train --resume a")
    assert resumed.status.state == "finished"
    assert resumed.config["resumes"][0]["command"] == "tom train --resume a"
    assert_same_record(undisturbed, resumed)


def test_a_finished_run_that_goes_on_has_its_last_fit_examined_anew(undisturbed, tmp_path: Path):
    store = Store(tmp_path)
    early = train(kept(steps=STOP), store, "a", rerun=False)

    def exams(run: RunReader) -> dict[int, float]:
        table = run.metrics().dropna(subset="exam/error")
        return dict(zip(table["env_step"], table["exam/error"], strict=True))

    first, whole = exams(early), exams(undisturbed)
    assert list(first) == [200, 300]  # the second over 47 steps so far
    assert list(whole) == [200, 300, 400]
    assert first[200] == whole[200]
    assert first[300] != whole[300]
    with pytest.raises(UserError, match="--steps"):
        resume(store, "a", rerun=False)
    longer = resume(store, "a", steps=STEPS, rerun=False)
    assert exams(longer) == whole
    assert longer.status.total == STEPS
    np.testing.assert_array_equal(longer.buffer()[0].obs, undisturbed.buffer()[0].obs)


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_a_gpus_run_is_refused_in_one_line_where_there_is_none(undisturbed, tmp_path: Path):
    shutil.copytree(undisturbed.path, tmp_path / "gpu")
    path = tmp_path / "gpu" / "config.json"
    path.write_text(path.read_text().replace('"device": "cpu"', '"device": "cuda"'))
    with pytest.raises(UserError, match="--device cuda"):
        resume(Store(tmp_path), "gpu", steps=1000, rerun=False)
    with pytest.raises(UserError, match="--device cuda:1"):
        train(kept(device="cuda:1"), Store(tmp_path), "new", rerun=False)
    assert not (tmp_path / "new").exists()
