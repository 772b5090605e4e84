from dataclasses import replace

import pytest
import torch
from common import generator
from made import ACTION, OBS, QUICK, ended, rows, uniform_policy
from torch import Tensor

from tom.config import TomConfig
from tom.data.scaling import Scaling
from tom.data.transitions import TensorTransitions
from tom.learners.dual import (
    Batch,
    DualProblem,
    QFunction,
    Validation,
    Values,
    dual_argument,
    dual_loss,
    values_of,
)
from tom.learners.terms import Flow
from tom.nn.mlp import StackedMLP


class TwoActions:
    """All at 0.25 with action (-1, -1), else (1, 1); sampling is refused."""

    def __call__(self, obs: Tensor, n: int, generator: torch.Generator) -> Tensor:
        raise AssertionError("a policy with a support need not be sampled")

    def support(self, obs: Tensor) -> tuple[Tensor, Tensor]:
        actions = torch.tensor([-1.0, 1.0])[:, None, None].expand(2, len(obs), ACTION)
        return actions, torch.tensor([[0.25], [0.75]]).expand(2, len(obs))


def problem(replay: TensorTransitions, config: TomConfig = QUICK, policy=uniform_policy):
    scaling = Scaling.of((replay.obs, replay.action))
    r = torch.linspace(-1, 1, len(replay))
    return DualProblem(replay, r, replay.obs[:20], policy, config, scaling)


FLOWS = ("discounted", "restart", "stationary")


def flow(name) -> Flow:
    return Flow.of(TomConfig(flow=name, discount=0.9))


def q_function(config: TomConfig = QUICK) -> QFunction:
    return QFunction(OBS, ACTION, config, generator(7))


def net(config: TomConfig = QUICK) -> StackedMLP:
    return q_function(config).net


def weights_of(found: DualProblem, q: StackedMLP) -> Tensor:
    """The weights (N,) at Q, not normalised."""
    return found.terms(q, generator()).raw(found.config)


def batch(terminated: float = 0.0) -> Batch:
    r = torch.tensor([0.5, -0.5])
    return Batch(torch.empty(0), torch.empty(0), torch.empty(0), r, torch.full((2,), terminated))


VALUES = Values(
    now=torch.tensor([1.0, 2.0]), following=torch.tensor([3.0, 1.0]), start=torch.tensor([4.0, 6.0])
)


def test_dual_loss_by_hand():
    config = TomConfig(discount=0.9)
    # y = 0.5 + 0.9 * 3 - 1 = 2.2 and -0.5 + 0.9 * 1 - 2 = -1.6, which the clamp turns into -1/2
    expected = 0.1 * 5 + (((3.2**2 - 1) / 2) + (-0.5)) / 2
    assert float(dual_loss(VALUES, batch(), config)) == pytest.approx(expected, rel=1e-5)
    released = 0.1 * 5 + (2.2**2 / 2 + 2.2 + 1.6**2 / 2 - 1.6) / 2
    config = config.but(conjugate="released")
    assert float(dual_loss(VALUES, batch(), config)) == pytest.approx(released, rel=1e-5)


def test_termination_masks_the_next_value():
    y = dual_argument(VALUES, torch.zeros(2), torch.tensor([0.0, 1.0]), flow("discounted"))
    torch.testing.assert_close(y, torch.tensor([0.9 * 3 - 1, -2.0]))


def test_a_restart_puts_a_new_start_after_an_end():
    y = dual_argument(VALUES, torch.zeros(2), torch.tensor([0.0, 1.0]), flow("restart"))
    torch.testing.assert_close(y, torch.tensor([0.9 * 3 - 1, 0.9 * 5 - 2]))
    y = dual_argument(VALUES, torch.zeros(2), torch.tensor([0.0, 1.0]), flow("stationary"))
    torch.testing.assert_close(y, torch.tensor([3.0 - 1, 5.0 - 2]))


def test_a_time_limit_ends_a_stationary_flow_alone():
    late = ended(rows(4), "truncated")
    assert [flow(name).ends(late).sum() for name in FLOWS] == [0, 0, late.truncated.sum()]
    both = replace(late, terminated=late.truncated)  # as Gymnasium says of a fall at the limit
    assert torch.equal(flow("stationary").ends(both), late.truncated)


def test_the_dual_of_a_stationary_flow_by_hand():
    # y = 2.5 and -1.5 as values of a batch without ends: lambda = 1.5 and weights 2 and 0
    config = TomConfig(flow="stationary")
    values = replace(VALUES, following=torch.tensor([3.0, 1.0]))
    expected = 1.5 + ((2.0**2 - 1) / 2 - 0.5) / 2
    assert float(dual_loss(values, batch(), config)) == pytest.approx(expected, rel=1e-5)


def test_the_level_of_q_moves_nothing_in_a_stationary_flow():
    replay, config = ended(rows(64), "terminated"), QUICK.but(flow="stationary")
    q = net()
    raised = net()
    with torch.no_grad():
        raised.layers[-1][1].add_(3.0)
    found = problem(replay, config, TwoActions())
    weights, level = (weights_of(found, one) for one in (q, raised))
    torch.testing.assert_close(weights, level, atol=1e-4, rtol=1e-4)
    assert float(weights.mean()) == pytest.approx(1.0, abs=1e-5)


def test_a_validated_q_is_the_best_on_episodes_that_it_never_saw():
    config = QUICK.but(q_steps=600, q_lr=1e-2, q_holdout=0.25, q_check_every=20, flow="stationary")
    found, q = problem(ended(rows(600), "terminated"), config), q_function(config)
    best, metrics = found.minimise(q, generator())
    _, held_out = found.split(generator())
    # The overfitted last network is worse on the held-out rows than the one that was kept.
    assert 0 < metrics["dual/steps"] < 600
    loss = held_out.loss_of(2000, generator(5))
    assert loss(best) < loss(q.net)


def test_the_last_step_is_judged_though_it_is_between_two_looks():
    losses = iter([3.0, 2.0, 1.0])
    validation = Validation(
        net(), lambda _: next(losses), QUICK.but(q_steps=50, q_check_every=20, q_holdout=0.25)
    )
    for step in range(1, 51):
        validation.is_over(step)
    assert validation.metrics == {"dual/holdout_loss": 1.0, "dual/steps": 50}


def test_what_a_validated_q_draws_does_not_depend_on_when_it_stops():
    ends = []
    for patience in (1, 30):
        config = QUICK.but(q_steps=60, q_holdout=0.25, q_check_every=2, q_patience=patience)
        source = generator(3)
        problem(rows(600), config).minimise(q_function(config), source)
        ends.append(torch.rand(1, generator=source))
    assert torch.equal(*ends)


def test_the_exact_expectation_weighs_every_action_by_its_probability():
    replay, q = rows(64), net()
    found = problem(replay, QUICK.but(discount=0.9), TwoActions())
    weights, now = weights_of(found, q), found.terms(q, generator()).now

    def value(obs: Tensor, action: Tensor) -> Tensor:
        return q(found.scaling(torch.cat((obs, action), 1))[None])[0, :, 0].detach()

    down, up = torch.full((64, ACTION), -1.0), torch.ones(64, ACTION)
    following = 0.25 * value(replay.next_obs, down) + 0.75 * value(replay.next_obs, up)
    y = found.log_ratio + 0.9 * following - value(replay.obs, replay.action)
    torch.testing.assert_close(weights, (1 + y).clamp(min=0), atol=1e-5, rtol=1e-4)
    torch.testing.assert_close(now, value(replay.obs, replay.action), atol=1e-5, rtol=1e-4)


def test_the_gradient_runs_through_the_next_value_unless_it_is_stopped():
    replay = rows(64)
    slopes = []
    for semi in (False, True):
        q = net()
        found = problem(replay, QUICK.but(semi_gradient=semi, q_batch=16), TwoActions())
        first = next(iter(found.batches(generator())))
        value = q(first.inputs[None])[0, :, 0]
        following = values_of(value, first, found.config).following
        slopes.append(following.requires_grad)
    assert slopes == [True, False]


def test_minimising_lowers_the_dual_and_lets_the_flow_hold():
    config = QUICK.but(q_steps=400, q_lr=1e-3, q_bias_step=0.1, discount=0.9, action_samples=4)
    found, q = problem(rows(2000), config), q_function(config)
    _, early = replace(found, config=config.but(q_steps=10)).minimise(q, generator())
    _, late = found.minimise(q, generator())
    assert late["dual/loss"] < early["dual/loss"] - 0.01
    assert float(weights_of(found, q.net).mean()) == pytest.approx(1.0, abs=0.05)


def test_q_is_never_negative_where_the_paper_prints_it_so():
    config = QUICK.but(q_non_negative=True)
    terms = problem(rows(64), config).terms(net(config), generator())
    assert (terms.now >= 0).all()
