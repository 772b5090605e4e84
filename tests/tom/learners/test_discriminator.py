from dataclasses import replace

import pytest
import torch
from common import generator
from made import QUICK, rows
from torch.nn.functional import binary_cross_entropy_with_logits

from tom.config import TomConfig
from tom.data.transitions import TensorTransitions
from tom.learners.discriminator import (
    Discriminator,
    RatioProblem,
    accuracy,
    calibration_error,
    cross_entropy,
    membership_reward,
)

SHIFT = 1.0
CONFIG = QUICK.but(discriminator_steps=300, discriminator_lr=1e-3, parameter_average=0.99)


def trained(
    replay: TensorTransitions, policy_buffer: TensorTransitions, config: TomConfig = CONFIG
) -> tuple[torch.Tensor, dict[str, float]]:
    """r of the replay's rows, (N,), and metrics."""
    return judged(replay, policy_buffer, replay, config)


def judged(
    replay: TensorTransitions,
    policy_buffer: TensorTransitions,
    seen: TensorTransitions,
    config: TomConfig = CONFIG,
) -> tuple[torch.Tensor, dict[str, float]]:
    """The logit of the rows `seen`, which need not be the replay's, and metrics."""
    g = generator(1)
    problem = RatioProblem.of(policy_buffer, replay, config)
    dims = replay.obs.shape[1], replay.action.shape[1]
    fitted, metrics = problem.solve(Discriminator(*dims, config, g), g)
    return replace(problem, replay=seen).log_ratio(fitted), metrics


def exact(batch: TensorTransitions) -> torch.Tensor:
    """log p/q of unit normals around SHIFT and 0, in each dimension."""
    return (SHIFT * batch.obs - SHIFT**2 / 2).sum(1)


def correlation(x: torch.Tensor, y: torch.Tensor) -> float:
    return float(torch.corrcoef(torch.stack((x, y)))[0, 1])


def test_the_logit_is_the_log_ratio_and_swapped_labels_reverse_it():
    replay, policy_rows = rows(4000, seed=0), rows(4000, seed=1, shift=SHIFT)
    r, metrics = trained(replay, policy_rows)
    assert correlation(r, exact(replay)) > 0.97
    slope = float((r * exact(replay)).mean() / exact(replay).square().mean())
    assert slope == pytest.approx(1.0, abs=0.2)  # its size too, not the order alone
    assert metrics["discriminator/accuracy"] > 0.75
    assert metrics["discriminator/loss"] < 0.5
    backward, _ = judged(policy_rows, replay, replay)
    assert correlation(backward, exact(replay)) < -0.97


def test_a_policy_that_is_the_replays_gets_a_logit_near_zero():
    r, metrics = trained(rows(4000, seed=0), rows(4000, seed=1))
    assert float(r.abs().mean()) < 0.3
    assert metrics["discriminator/accuracy"] == pytest.approx(0.5, abs=0.06)


def test_a_gradient_penalty_compresses_the_logit():
    replay, policy_rows = rows(2000, seed=0), rows(2000, seed=1, shift=SHIFT)
    config = CONFIG.but(discriminator_steps=150)
    free, _ = trained(replay, policy_rows, config)
    held, _ = trained(replay, policy_rows, config.but(gradient_penalty=10.0))
    assert float(held.std()) < 0.8 * float(free.std())


@pytest.mark.parametrize("smoothing", [0.0, 0.1])
def test_cross_entropy_labels_policy_one_and_replay_the_smoothing(smoothing):
    logits = torch.randn(20, generator=generator())
    target = torch.cat((torch.ones(10), torch.full((10,), smoothing)))
    expected = binary_cross_entropy_with_logits(logits, target)
    torch.testing.assert_close(cross_entropy(logits, smoothing), expected)


def test_membership_is_one_exactly_on_the_policy_buffers_rows():
    replay = rows(1000)
    chosen = torch.tensor([3, 500, 999])
    found = membership_reward(replay, replay[chosen])
    assert found[chosen].tolist() == [1.0, 1.0, 1.0]
    assert float(found.sum()) == 3.0
    assert float(membership_reward(replay, rows(50, seed=9)).sum()) == 0.0


def test_accuracy_and_calibration_error_by_hand():
    """Of three rows at c = 0.8 two are the policy's; the one at c = 0.2 is not."""
    logits = torch.logit(torch.tensor([0.8, 0.8, 0.8, 0.2]))  # two policy rows, two replay rows
    assert float(accuracy(logits)) == pytest.approx(0.75)
    expected = (3 * abs(2 / 3 - 0.8) + 1 * abs(0 - 0.2)) / 4
    assert float(calibration_error(logits)) == pytest.approx(expected, abs=1e-6)
    assert calibration_error(torch.tensor([0.0, torch.nan, 1.0, -1.0])).isnan()


def test_a_discriminator_of_state_actions_is_blind_to_what_came_next():
    replay, policy_rows = rows(4000, seed=0), rows(4000, seed=1, shift=SHIFT)
    elsewhere = replace(replay, next_obs=replay.next_obs.flip(0))
    config = CONFIG.but(discriminator_input="state-actions")
    r, _ = trained(replay, policy_rows, config)
    blind, _ = judged(replay, policy_rows, elsewhere, config)
    assert torch.equal(r, blind)
    assert correlation(r, exact(replay)) > 0.97
    seeing, _ = judged(replay, policy_rows, elsewhere)
    assert not torch.equal(trained(replay, policy_rows)[0], seeing)
