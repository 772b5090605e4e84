"""Resumed and uninterrupted training are the same to the last bit."""

from collections.abc import Iterator
from io import BytesIO
from typing import Any

import numpy as np
import pytest
import torch

from tom.config import OnlineConfig
from tom.data.transitions import Transitions
from tom.events import Collected, Evaluation, Event, Metrics, Tick, Weights
from tom.learners import LEARNER_NAMES
from tom.mbpo import Mbpo
from tom.presets import resolve

STEPS, STOP = 430, 347  # stops within an episode and between two fits


def smoke(env: str, learner: str) -> OnlineConfig:
    config = resolve(env, learner, "smoke", {"steps": STEPS, "tom": {"warmup": 50}})
    assert isinstance(config, OnlineConfig)
    return config


def until(events: Iterator[Event], step: int) -> list[Event]:
    """The events up to the end of environment step `step`."""
    seen = []
    for event in events:
        seen.append(event)
        if event == Tick(step, "optimise"):
            return seen
    pytest.fail(f"no end of step {step}")


def through_a_file(state: dict[str, Any]) -> dict[str, Any]:
    """Saved and loaded without executing code."""
    file = BytesIO()
    torch.save(state, file)
    file.seek(0)
    return torch.load(file, weights_only=True)


def collected(events: list[Event]) -> tuple[Transitions, np.ndarray]:
    parts = [e for e in events if isinstance(e, Collected)]
    rows = Transitions.concatenate([p.transitions for p in parts])
    return rows, np.concatenate([p.policy_version for p in parts])


def assert_same(first: list[Event], second: list[Event]) -> None:
    assert len(first) == len(second)
    for a, b in zip(first, second, strict=True):
        assert type(a) is type(b)
        assert a.env_step == b.env_step
        if isinstance(a, Metrics) and isinstance(b, Metrics):
            np.testing.assert_equal(a.values, b.values)
        elif isinstance(a, Weights) and isinstance(b, Weights):
            np.testing.assert_array_equal(a.weight, b.weight)
        elif isinstance(a, Evaluation) and isinstance(b, Evaluation):
            for x, y in zip(a.episodes, b.episodes, strict=True):
                np.testing.assert_array_equal(x.obs, y.obs)
        elif isinstance(a, Collected) and isinstance(b, Collected):
            np.testing.assert_array_equal(a.transitions.numpy().obs, b.transitions.numpy().obs)


@pytest.mark.parametrize("learner", LEARNER_NAMES)
@pytest.mark.parametrize("env", ["hopper", "inverted-pendulum"])
def test_resumed_equals_uninterrupted(env: str, learner: str):
    config = smoke(env, learner)
    training = Mbpo(config)
    events = training.events()
    before = until(events, STOP)
    state = through_a_file(training.state_dict())
    undisturbed = list(events)

    resumed = Mbpo(config)
    resumed.load_state_dict(state, *collected(before))
    assert_same(undisturbed, list(resumed.events()))
    for a, b in zip(training.sac.actor.parameters(), resumed.sac.actor.parameters(), strict=True):
        assert torch.equal(a, b)


def test_a_run_stopped_while_exploring_goes_on():
    config = smoke("hopper", "mle")
    training = Mbpo(config)
    events = training.events()
    for event in events:
        if event == Tick(37, "explore"):
            break
    state = through_a_file(training.state_dict())
    undisturbed = list(events)
    resumed = Mbpo(config)
    empty = training.replay.transitions()[:0].numpy()
    resumed.load_state_dict(state, empty, np.empty(0, np.int64))
    assert_same(undisturbed, list(resumed.events()))
