"""Every number of an exam where it is known by hand, and exams in trainings."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from common import generator, online, present
from torch import Tensor

from tom.config import OnlineConfig
from tom.data.transitions import TensorTransitions
from tom.events import Event, Metrics, Tick, Weights
from tom.exams.diagnostics import one_step_error
from tom.exams.exam import (
    Exam,
    Fitted,
    critic_metrics,
    footprint_metrics,
    model_metrics,
    returns_to_go,
)
from tom.learners import LEARNERS
from tom.mbpo import Mbpo


def line(n: int, ends: tuple[int, ...] = (), truncated: tuple[int, ...] = ()) -> TensorTransitions:
    """A point that moves by its action, alternately 1 and 3, with a reward of four times that."""
    action = torch.tensor([1.0, 3.0]).repeat(n)[:n, None]
    next_obs = action.cumsum(0)
    flags = torch.zeros(2, n)
    flags[0, list(ends)] = 1.0
    flags[1, list(truncated)] = 1.0
    return TensorTransitions(next_obs - action, action, 4 * action[:, 0], next_obs, *flags)


class Off:
    """Off by `bias` in each step and by `reward` in the reward; every 4th draw is 99."""

    def __init__(self, bias: float, reward: float, nll: Tensor | None = None) -> None:
        self.bias, self.reward, self.known_nll = bias, reward, nll

    def predict(self, obs: Tensor, action: Tensor) -> tuple[Tensor, Tensor]:
        return 4 * action[:, 0] + self.reward, obs + action + self.bias

    def sample(
        self, obs: Tensor, action: Tensor, generator: torch.Generator
    ) -> tuple[Tensor, Tensor]:
        reward, next_obs = self.predict(obs, action)
        far = torch.arange(len(obs)) % 4 == 0
        return reward, torch.where(far[:, None], 99.0, next_obs)

    def nll(self, rows: TensorTransitions) -> Tensor | None:
        return self.known_nll


def judged(model: Off, rows: TensorTransitions, limit: float = 98.0) -> dict[str, float]:
    return model_metrics(
        model,  # pyright: ignore[reportArgumentType]
        Exam(line(40), torch.ones(40), rows),
        lambda next_obs: next_obs[:, 0] > limit,
        generator(),
    )


def test_errors_are_in_the_buffers_standard_deviations_and_add_up_over_a_rollout():
    # A step of the buffer changes by 2 +- 1, and its reward is 8 +- 4.
    found = judged(Off(bias=0.5, reward=2.0), line(20))
    assert found["exam/error"] == pytest.approx(0.5)
    assert found["exam/reward_error"] == pytest.approx(0.5)
    assert found["exam/rollout_error"] == pytest.approx(2.5)
    assert found["exam/rollout_reward_error"] == pytest.approx(0.5)


def test_no_rollout_crosses_the_end_of_an_episode():
    assert "exam/rollout_error" not in judged(Off(0.5, 0.0), line(8, ends=(3,)))
    assert "exam/rollout_error" not in judged(Off(0.5, 0.0), line(4))
    assert judged(Off(0.5, 0.0), line(9, (3,)))["exam/rollout_error"] == pytest.approx(2.5)


def test_the_likelihood_is_the_models_own_and_absent_without_one():
    found = judged(Off(0.0, 0.0, nll=torch.tensor([[1.0, 2.0], [3.0, 6.0]])), line(2))
    assert found["exam/nll"] == 3.0
    assert "exam/nll" not in judged(Off(0.0, 0.0), line(2))


def test_falls_caught_and_false_ones():
    # The 5th and the 10th row end; one draw in four is a fall wherever it is.
    found = judged(Off(0.0, 0.0), line(12, ends=(4, 9)))
    assert found["exam/falls_caught"] == found["exam/false_falls"] == 0.25
    # The last row alone ends beyond 22.5, and a model of the right mean knows it.
    knows = judged(Off(0.0, 0.0), line(12, ends=(11,)), limit=22.5)
    assert knows["exam/falls_caught"] == 1.0
    assert "exam/falls_caught" not in judged(Off(0.0, 0.0), line(6))
    only_falls = judged(Off(0.0, 0.0), line(2, ends=(0, 1)))
    assert "exam/false_falls" not in only_falls


def test_a_return_to_go_counts_entropy_and_ends_as_its_episode_does():
    entropy, value = torch.full((6,), 0.2), torch.full((6,), 10.0)
    rows = TensorTransitions(
        torch.zeros(6, 1), torch.zeros(6, 1), torch.ones(6), torch.zeros(6, 1),
        torch.tensor([0, 0, 1.0, 0, 0, 0]), torch.tensor([0, 0, 0, 0, 1.0, 0]),
    )  # fmt: skip
    found = returns_to_go(rows, entropy, value, 0.5)
    # Terminated: 1, 1 + (.2 + 1) / 2, ...; truncated: 1 + (.2 + 10) / 2; the last never ended.
    assert found.tolist() == pytest.approx([1.9, 1.6, 1.0, 4.15, 6.1])
    assert len(returns_to_go(rows[:2], entropy[:2], value[:2], 0.5)) == 0
    both = replace(rows[2:3], truncated=torch.ones(1))
    assert returns_to_go(both, entropy[:1], value[:1], 0.5).tolist() == [1.0]


class Knows:
    """The value of a task with a reward of 1 and 3 steps left, `off` by some; log pi is -2."""

    def __init__(self, off: float) -> None:
        self.off = off

    def draw(self, obs: Tensor, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        return torch.zeros(len(obs), 1), torch.full((len(obs),), -2.0)

    def value(self, obs: Tensor, action: Tensor) -> Tensor:
        left = 3 - obs[:, 0].long()
        return torch.tensor([0.0, 1.0, 1.6, 1.9])[left.clamp(0, 3)] + self.off


def test_a_critic_that_knows_the_soft_value_has_no_bias():
    obs = torch.tensor([0.0, 1.0, 2.0] * 2)[:, None]
    ends = torch.tensor([0, 0, 1.0] * 2)
    rows = TensorTransitions(obs, torch.zeros(6, 1), torch.ones(6), obs + 1, ends, torch.zeros(6))
    for off in (0.0, 0.7):
        found = critic_metrics(Knows(off), rows, 0.1, 0.5, generator())
        assert found["exam/critic_bias"] == pytest.approx(-off, abs=1e-6)
    assert critic_metrics(Knows(0.0), rows[:2], 0.1, 0.5, generator()) == {}


def test_the_exam_is_of_the_newest_rows_and_the_buffer_of_what_the_fit_saw():
    rows = line(10)
    exam = Exam.of(Fitted(7, torch.arange(7.0)), rows, 3)
    assert torch.equal(exam.buffer.obs, rows.obs[:7])
    assert torch.equal(exam.rows.obs, rows.obs[7:])
    assert exam.weights.tolist() == [0, 1, 2, 3, 4, 5, 6]
    dropped = Exam.of(Fitted(12, torch.arange(12.0)), rows, 3)  # the oldest 5 rows are gone
    assert dropped.weights.tolist() == [5, 6, 7, 8, 9, 10, 11]
    gone = Exam.of(Fitted(3, torch.ones(3)), rows, 12)
    assert len(gone.buffer) == len(gone.weights) == 0
    assert len(gone.rows) == 10


def test_without_a_buffer_or_weights_nothing_is_measured():
    rows = line(10)
    gone = Exam.of(Fitted(3, torch.ones(3)), rows, 12)
    assert footprint_metrics(gone, generator()) == {}
    assert model_metrics(Off(0, 0), gone, lambda x: x[:, 0] > 0, generator()) == {}  # pyright: ignore[reportArgumentType]
    dropped = Exam.of(Fitted(9, torch.tensor([1.0, 1, 0, 0, 0, 0, 0, 0, 0])), rows, 3)
    assert footprint_metrics(dropped, generator()) == {}


def test_weights_like_the_exams_rows_are_near_it():
    g = generator()
    far, near, met = (torch.randn(n, 1, generator=g) for n in (500, 500, 200))
    x = torch.cat([far, near + 5])

    def of(obs: Tensor) -> TensorTransitions:
        flat = torch.zeros(len(obs))
        ends = (torch.arange(len(obs)) % 20 == 19).float()
        return TensorTransitions(obs, flat[:, None], flat, obs, flat, ends)

    weights = torch.cat([torch.zeros(500), 2 * torch.ones(500)])
    found = footprint_metrics(Exam(of(x), weights, of(met + 5)), generator())
    assert abs(found["exam/footprint"]) < 3 * found["exam/footprint_se"] < 0.2
    assert abs(found["exam/footprint_noise"]) < 0.2
    assert found["exam/footprint_uniform"] > 0.3


# In a training


def smoke(learner: str, **changes: object) -> OnlineConfig:
    return online("inverted-pendulum", learner, {"tom": {"warmup": 50}, **changes})


def exams(events: list[Event]) -> dict[int, dict[str, float]]:
    return {
        e.env_step: e.values
        for e in events
        if isinstance(e, Metrics) and any(name.startswith("exam/") for name in e.values)
    }


def test_every_fit_sits_one_exam_under_its_own_step():
    training = Mbpo(smoke("tom", steps=460))
    events = list(training.events())
    found = exams(events)
    assert list(found) == [200, 300, 400]
    ticks = [e.env_step for e in events if isinstance(e, Tick) and e.phase == "fit"]
    assert ticks == [200, 300, 400]
    new = training.replay.since(400)
    assert len(new) == 60
    change = (training.replay.transitions().next_obs - training.replay.transitions().obs)[:400]
    error = one_step_error(training.model, new, change.std(0, correction=0))
    assert found[400]["exam/error"] == pytest.approx(error, rel=1e-5)


def test_the_weights_that_are_examined_are_the_fits():
    for learner, changes in (("tom", {"model": {"weight_clip": 1.01}}), ("vagram", {})):
        training = Mbpo(smoke(learner, steps=301, **changes))
        weights = [e for e in training.events() if isinstance(e, Weights)][-1]
        fitted = present(training._fitted)
        assert np.ptp(weights.weight) > 0
        clip = 1.01 if learner == "tom" else np.inf
        np.testing.assert_array_equal(fitted.weights, weights.weight.clip(max=clip))


@pytest.mark.parametrize(
    "changes",
    [
        {"learner": "tom", "replay_capacity": 60},
        *(
            pytest.param(changes, marks=pytest.mark.slow)
            for changes in (
                *({"learner": name} for name in LEARNERS),
                {"model": {"kind": "ensemble"}},
            )
        ),
    ],
    ids=str,
)
def test_a_training_does_not_notice_its_exams(changes: dict, monkeypatch: pytest.MonkeyPatch):
    rest = {"learner": "tom", "steps": 330, "fit_every": 50, **changes}
    config = smoke(rest.pop("learner"), **rest)
    kept = list(Mbpo(config).events())
    monkeypatch.setattr(Mbpo, "examine", lambda self: iter(()))
    without = list(Mbpo(config).events())
    assert exams(kept)
    assert not exams(without)
    rest = [e for e in kept if not isinstance(e, Metrics) or e.values not in exams(kept).values()]
    assert [type(e) for e in rest] == [type(e) for e in without]
    for a, b in zip(rest, without, strict=True):
        assert a.env_step == b.env_step
        if isinstance(a, Metrics) and isinstance(b, Metrics):
            np.testing.assert_equal(a.values, b.values)
