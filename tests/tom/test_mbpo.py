from typing import Any

import numpy as np
import pytest
import torch
from common import online
from gymnasium import Wrapper
from gymnasium.envs.mujoco import MujocoEnv
from gymnasium.wrappers import TimeLimit

from tom.config import OnlineConfig
from tom.data.replay import ReplayBuffer
from tom.data.transitions import TensorTransitions, Transitions
from tom.dynamics.base import FitReport
from tom.events import Collected, Evaluation, Event, Metrics, Notice, Weights
from tom.learners.base import FitContext, Weighting
from tom.learners.mle import MleLearner
from tom.mbpo import Mbpo


def smoke(learner: str = "tom", **changes: object) -> OnlineConfig:
    return online("inverted-pendulum", learner, changes)


def run(config: OnlineConfig) -> tuple[Mbpo, list[Event]]:
    training = Mbpo(config)
    return training, list(training.events())


def of(events: list[Event], kind: type) -> list:
    return [e for e in events if isinstance(e, kind)]


@pytest.mark.parametrize("capacity", [1, 70, 130, 1000])
def test_every_transition_is_handed_over_once_and_in_order(capacity: int):
    """Also where the buffer holds less than the exploration, or than the steps between two fits."""
    training, events = run(smoke("mle", steps=350, replay_capacity=capacity))
    parts = of(events, Collected)
    rows = Transitions.concatenate([p.transitions for p in parts])
    versions = np.concatenate([p.policy_version for p in parts])
    np.testing.assert_array_equal(versions, [0] * 200 + list(range(1, 151)))
    held = training.replay.transitions().numpy()
    np.testing.assert_array_equal(rows.obs[-capacity:], held.obs)
    goes_on = np.flatnonzero(~rows.ended()[:-1])
    np.testing.assert_array_equal(rows.next_obs[goes_on], rows.obs[goes_on + 1])
    handed = np.cumsum([len(p.transitions) for p in parts]).tolist()
    assert handed == [p.env_step for p in parts]  # a row's number is its step


def test_exploration_is_no_part_of_the_policy_buffer():
    training, _ = run(smoke(steps=500))
    on_policy = training.policy_buffer
    assert len(on_policy) == 300
    assert torch.equal(on_policy.obs, training.replay.transitions().obs[200:])
    versions = training.replay.policy_version()
    assert versions[:200].eq(0).all()
    assert versions[200] == 1
    assert versions[200:].diff().ge(0).all()


def test_the_policy_buffer_holds_the_last_on_policy_transitions():
    training = Mbpo(smoke(steps=90, exploration_steps=60, fit_every=10, policy_capacity=20))
    list(training.events())
    assert torch.equal(training.policy_buffer.packed(), training.replay.transitions().packed()[70:])


def test_a_policy_that_does_not_fall_is_cut_off_as_truncated():
    """A time limit must bootstrap: the stored row is truncated, not terminated."""
    training = Mbpo(smoke(steps=60, exploration_steps=60))
    simulator, limit = training.env.unwrapped, training.env
    assert isinstance(simulator, MujocoEnv)
    simulator.model.opt.gravity[:] = 0.0  # nothing falls
    while not isinstance(limit, TimeLimit):
        assert isinstance(limit, Wrapper)
        limit = limit.env
    limit._max_episode_steps = 20
    training._random_action = lambda: np.zeros(1, np.float32)
    list(training.events())
    rows = training.replay.transitions()
    assert rows.truncated.sum() == 3
    assert rows.terminated.sum() == 0


def test_the_model_buffer_keeps_an_epoch_of_fits():
    """1000 env steps' rollouts: Janner's pool, which the authors' code sizes alike."""
    config = smoke("mle", steps=450, exploration_steps=50, fit_every=100, rollout={"starts": 20})
    training, _ = run(config)
    assert training.model_buffer.capacity == 10 * 20
    assert len(training.model_buffer) == 4 * 20  # four fits, and none was thrown away


def packed(buffer: ReplayBuffer) -> set[bytes]:
    rows = buffer.packed(torch.arange(len(buffer))).numpy()
    return {row.tobytes() for row in rows}


def test_every_step_updates_the_policy_on_its_share_of_real_transitions():
    changes = {"updates_per_step": 3, "real_ratio": 0.25, "sac": {"batch_size": 40}}
    training, found = Mbpo(smoke("mle", steps=202, **changes)), []
    updates = training.sac.updates

    def noted(batches: torch.Tensor) -> dict[str, torch.Tensor]:
        real, model = packed(training.replay), packed(training.model_buffer)
        found.append(batches.shape)
        for batch in batches.numpy():
            rows = [row.tobytes() for row in batch]
            assert sum(row in real for row in rows) == 10
            assert sum(row in model for row in rows) == 30
        return updates(batches)

    training.sac.updates = noted
    list(training.events())
    assert [shape[:2] for shape in found] == [(3, 40)] * 2  # an env step after exploration each
    assert float(training.sac.actor_optimiser.taken[0]) == 6


@pytest.mark.parametrize("weighted", [True, False])
@pytest.mark.parametrize("ready", [True, False])
def test_rollouts_start_by_weight_where_there_are_weights(weighted: bool, ready: bool):
    """Also by weights beyond those that a fit of the model takes: it clips them, starts do not."""
    training = Mbpo(smoke("mle", rollout={"starts": 400, "weighted_starts": weighted}))
    obs = torch.arange(200.0)[:, None].repeat(1, 4)
    flat = torch.zeros(200)
    replay = TensorTransitions(obs, flat[:, None], flat, obs, flat, flat)
    weights = torch.zeros(200)
    weights[[7, 8]] = torch.tensor([180.0, 20.0])
    training.roll_out_model(replay, Weighting(weights, ready=ready, clipped=True))
    started = training.model_buffer.transitions().obs[:, 0]
    assert len(started) == 400
    if weighted and ready:
        assert set(started.tolist()) == {7.0, 8.0}
        assert (started == 7).float().mean() == pytest.approx(0.9, abs=0.05)
    else:
        assert len(started.unique()) > 100


class OneRow(MleLearner):
    """Nearly all of the weight on one row."""

    def weigh(self, context: FitContext) -> Weighting:
        weights = torch.full((len(context.replay),), 0.01)
        weights[3] = 0.99 * len(weights) + 0.01
        return Weighting(weights, clipped=True)


def test_a_fit_whose_rollouts_start_from_one_row_is_told():
    """The fit clips such a row; rollouts start there, unless some are to start anywhere."""
    for share, told in ((0.0, {"heavy-row"}), (0.95, set())):
        training = Mbpo(smoke("mle", steps=350, rollout={"uniform_share": share}))
        training.learner = OneRow()
        assert {one.kind for one in of(list(training.events()), Notice)} == told


def test_the_model_is_fitted_to_clipped_weights_and_the_record_keeps_them_whole(
    monkeypatch: pytest.MonkeyPatch,
):
    training = Mbpo(smoke(steps=301, model={"weight_clip": 1.01}))
    fits, fit = [], training.model.fit

    def noted(data: TensorTransitions, weights: torch.Tensor, *rest: Any) -> FitReport:
        fits.append(weights)
        return fit(data, weights, *rest)

    monkeypatch.setattr(training.model, "fit", noted)
    recorded = [torch.from_numpy(w.weight) for w in of(list(training.events()), Weights)]
    assert recorded[1].max() > 1.01
    assert torch.equal(fits[1], recorded[1].clamp(max=1.01))


def test_evaluation_leaves_the_training_alone():
    """More evaluations change no metric of the training itself."""
    often = run(smoke("mle", steps=450, evaluation={"every": 50}))[0]
    seldom = run(smoke("mle", steps=450, evaluation={"every": 450}))[0]
    assert torch.equal(often.replay.transitions().obs, seldom.replay.transitions().obs)
    for a, b in zip(often.sac.actor.parameters(), seldom.sac.actor.parameters(), strict=True):
        assert torch.equal(a, b)


@pytest.mark.slow
def test_it_begins_to_balance():
    """Soon it is several times better than random actions."""
    changes = {"steps": 550, "updates_per_step": 6}
    config = online("inverted-pendulum", "mle", changes, "paper")
    events = run(config)[1]
    at_random = [
        e.values["train/length"] for e in of(events, Metrics) if "train/length" in e.values
    ]
    evaluations = of(events, Evaluation)
    best = max(np.mean([e.undiscounted_return for e in v.episodes]) for v in evaluations)
    assert best > 2.5 * np.mean(at_random[:20])
