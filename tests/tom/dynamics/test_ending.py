"""The head that learns what ends an episode: it finds the rule and says how sure it is."""

import pytest
import torch
from common import generator, online

from tom.config import ModelConfig
from tom.data.transitions import TensorTransitions
from tom.dynamics.ending import NEVER, EndingHead, best_threshold, measured
from tom.events import Metrics
from tom.mbpo import Mbpo

CONFIG = ModelConfig(batches_per_round=100)


def rows(n: int, ends: bool = True, seed: int = 0) -> TensorTransitions:
    """A walk that ends where the first of three numbers falls below -1 (a sixth of the rows)."""
    g = generator(seed)
    obs, next_obs = torch.randn(2, n, 3, generator=g)
    fell = (next_obs[:, 0] < -1).float() if ends else torch.zeros(n)
    none = torch.zeros(n)
    return TensorTransitions(obs, torch.zeros(n, 1), none, next_obs, fell, none)


def fitted(weights: torch.Tensor | None = None, config: ModelConfig = CONFIG, **given):
    data = rows(3000, **given)
    head = EndingHead(3, config, generator(1))
    weights = torch.ones(len(data)) if weights is None else weights
    metrics, notices = head.fit(data, weights, len(data), generator(2))
    return head, metrics, notices


@pytest.mark.parametrize("weights", ["sample", "scale"])
def test_it_learns_the_rule(weights: str):
    head, metrics, notices = fitted(config=CONFIG.but(weights=weights))
    fresh = rows(2000, seed=9)
    called, fell = head(fresh.next_obs), fresh.terminated > 0
    assert called[fell].float().mean() > 0.9
    assert called[~fell].float().mean() < 0.03
    assert metrics["model/ends_caught"] > 0.9
    assert metrics["model/ends_calibration"] < 0.05
    assert 0 < metrics["model/ends_threshold"] < 1
    assert notices == ()


def test_nothing_ends_before_an_end_was_seen():
    head, metrics, _ = fitted(ends=False)
    assert metrics == {"model/ends_threshold": NEVER}
    assert not head(torch.full((5, 3), -9.0)).any()
    assert not EndingHead(3, CONFIG, generator())(torch.zeros(5, 3)).any()


def test_rows_without_weight_are_not_learnt_from():
    data = rows(3000)
    other = data.next_obs[:, 1] > 0
    head, _, _ = fitted(torch.where(other, 2.0, 0.0))
    turned = rows(3000)
    turned.terminated[~other] = 1 - turned.terminated[~other]  # nonsense that counts nothing
    again = EndingHead(3, CONFIG, generator(1))
    again.fit(turned, torch.where(other, 2.0, 0.0), 3000, generator(2))
    fresh = rows(500, seed=4).next_obs
    assert head.threshold == pytest.approx(again.threshold)
    assert torch.allclose(head.probability(fresh), again.probability(fresh))


def test_ends_that_have_no_weight_are_learnt_without_weights_and_that_is_said():
    weights = 1 - rows(3000).terminated
    head, metrics, notices = fitted(weights)
    assert [kind for kind, _ in notices] == ["ends-unweighted"]
    plain, same, _ = fitted()
    assert metrics == same
    assert head.threshold == plain.threshold


def test_an_end_that_is_held_out_teaches_nothing():
    data = rows(3000, ends=False)
    head = EndingHead(3, CONFIG, generator(1))
    held, _ = head._split(data, 3000)
    data.terminated[held[100]] = 1
    metrics, notices = head.fit(data, torch.ones(3000), 3000, generator(2))
    assert metrics == {"model/ends_threshold": NEVER}
    assert notices == ()
    assert not head(rows(500, seed=9).next_obs).any()


def test_what_it_is_measured_on_was_never_trained_on():
    """Ends are chance in a fifth of the rows, so no honest loss is far below .50.

    The buffer forgets its oldest rows from fit to fit.
    """
    g, none = generator(3), torch.zeros(700)
    obs = torch.randn(700, 11, generator=g)
    ended = (torch.rand(700, generator=g) < 0.2).float()
    data = TensorTransitions(obs, obs[:, :1], none, obs, ended, none)
    head, losses = EndingHead(11, CONFIG, g), []
    for first in range(0, 200, 23):
        held, weights = data[first : first + 500], torch.ones(500)
        metrics, _ = head.fit(held, weights, first + 500, g)
        losses.append(metrics["model/ends_loss"])
    assert min(losses) > 0.4


def test_the_threshold_has_the_best_weighted_f1():
    p = torch.tensor([0.9, 0.8, 0.7, 0.6, 0.2])
    label = torch.tensor([1.0, 1.0, 0.0, 1.0, 0.0])
    assert best_threshold(p, label, torch.ones(5)) == pytest.approx(0.4)  # 3 of 4 called are right
    heavy = torch.tensor([1.0, 1.0, 9.0, 1.0, 1.0])
    assert best_threshold(p, label, heavy) == pytest.approx(0.75)
    assert best_threshold(p, torch.zeros(5), torch.ones(5)) == 0.5


def test_the_threshold_is_none_that_only_noise_would_choose():
    """A quarter of the weight ends, so that calling all has F1 .4, and half of that is .2."""
    p, even = torch.tensor([0.3, 0.2, 0.1, 0.01]), torch.ones(4)
    last = torch.tensor([0.0, 0.0, 0.0, 1.0])
    assert best_threshold(p, last, even) == pytest.approx(0.25)  # none from .2 on is better
    assert best_threshold(p / 10, last, even) == pytest.approx(0.2)
    low, second = torch.tensor([0.24, 0.14, 0.04, 0.01]), torch.tensor([0.0, 1.0, 0.0, 0.0])
    assert best_threshold(low, second, even) == pytest.approx(0.2)
    rare = torch.tensor([1.0, 1.0, 9.0, 9.0])  # a twentieth of the weight: none below .048
    assert best_threshold(low, second, rare) == pytest.approx(0.09)


def test_what_is_measured():
    p, label = torch.tensor([0.95, 0.95, 0.05, 0.05]), torch.tensor([1.0, 0.0, 0.0, 0.0])
    found = measured(p, label, torch.tensor([3.0, 1.0, 2.0, 2.0]), 0.5)
    assert found["model/ends_caught"] == 1
    assert found["model/ends_false"] == pytest.approx(1 / 5)
    # (3 of 4 end, said .95: 4 x .2; none of 4 ends, said .05: 4 x .05) over 8
    assert found["model/ends_calibration"] == pytest.approx((4 * 0.2 + 4 * 0.05) / 8)


@pytest.mark.slow
def test_the_exam_judges_it_like_a_rule():
    """Hopper's ends, learnt by the head: most of the falls are foretold, few are invented."""
    changes = {"model": {"termination": "learnt", "rounds": 20}, "steps": 1000}
    run = Mbpo(online("hopper", "mle", changes))
    told = [event.values for event in run.events() if isinstance(event, Metrics)]
    exams = [values for values in told if "exam/falls_caught" in values]
    assert len(exams) > 5
    assert max(values["exam/falls_caught"] for values in exams) > 0.3
    thresholds = [v["model/ends_threshold"] for v in told if "model/ends_threshold" in v]
    assert 0 < thresholds[-1] < 1
    assert any(values.get("rollout/terminated", 0) > 0 for values in told)
