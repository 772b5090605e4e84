from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.stats import chisquare

from tom.analysis.tabular import (
    Array,
    Mdp,
    OccupancyProblem,
    OneHotPolicy,
    dual_value,
    occupancy,
    primal_value,
    random_mdp,
    random_policy,
    sample_starts,
    sample_transitions,
    solve,
    transition_occupancy,
)
from tom.learners.divergences import divergence


def make(seed: int, successors: int, discount: float) -> tuple[Mdp, Array, Array, OccupancyProblem]:
    rng = np.random.default_rng(seed)
    mdp = random_mdp(8, 3, successors, discount, rng)
    target, behaviour = random_policy(mdp, rng), random_policy(mdp, rng, uniform=0.3)
    problem = OccupancyProblem.of(mdp, target, transition_occupancy(mdp, behaviour))
    return mdp, target, behaviour, problem


CASES = [(seed, k, g) for seed in range(4) for k in (1, 3) for g in (0.9, 0.99)]


def test_occupancy_is_the_discounted_sum_of_visits():
    mdp, policy, _, _ = make(0, 3, 0.9)
    state, total = mdp.start, np.zeros((mdp.states, mdp.actions))
    for t in range(400):
        visits = state[:, None] * policy
        total += (1 - mdp.discount) * mdp.discount**t * visits
        state = np.einsum("ij,ijk->k", visits, mdp.transition)
    np.testing.assert_allclose(occupancy(mdp, policy), total, atol=1e-12)
    assert transition_occupancy(mdp, policy).sum() == pytest.approx(1.0)


def test_a_terminal_state_ends_the_path():
    mdp, policy, _, _ = make(0, 3, 0.9)
    terminal = np.zeros(mdp.states, bool)
    terminal[2] = True
    start = np.where(terminal, 0.0, mdp.start)
    mdp = replace(mdp, terminal=terminal, start=start / start.sum())
    d = occupancy(mdp, policy)
    assert d[2].sum() == 0
    lost = mdp.discount * transition_occupancy(mdp, policy)[:, :, 2].sum()
    assert d.sum() * (1 - mdp.discount) == pytest.approx(1 - mdp.discount - lost)


@pytest.mark.parametrize("seed", range(4))
def test_chi_square_takes_weight_from_transitions_that_end_an_episode(seed: int):
    """Where a step in a hundred ends: less than their share of the policy's, many exactly none."""
    rng = np.random.default_rng(seed)
    mdp = random_mdp(20, 3, 3, 0.99, rng)
    terminal = np.arange(20) == 19
    alive, start = (np.where(terminal, 0.0, x) for x in (mdp.transition + 1e-4, mdp.start))
    transition = 0.99 * alive / alive.sum(2, keepdims=True) + 0.01 * terminal
    mdp = replace(mdp, terminal=terminal, transition=transition, start=start / start.sum())
    target, behaviour = random_policy(mdp, rng, uniform=0.1), random_policy(mdp, rng, uniform=0.3)
    p, q = transition_occupancy(mdp, target), transition_occupancy(mdp, behaviour)
    problem = OccupancyProblem.of(mdp, target, q / q.sum())
    # A discriminator compares distributions: both have mass one there.
    problem = replace(problem, log_ratio=problem.log_ratio - np.log(p.sum()))
    weights, ends = solve(problem, "chi2").weights, terminal[problem.index[2]]
    mass, replay = problem.replay * weights, problem.replay
    assert p[..., terminal].sum() / p.sum() == pytest.approx(0.01)
    assert 0.003 < mass[ends].sum() / mass.sum() < 0.0085
    unheard = weights < 1e-9
    assert 0.3 < replay[ends & unheard].sum() / replay[ends].sum() < 0.7
    assert replay[unheard].sum() < 0.1


@pytest.mark.parametrize("name", ["chi2", "kl"])
@pytest.mark.parametrize(("seed", "successors", "discount"), CASES)
def test_strong_duality(seed, successors, discount, name):
    problem = make(seed, successors, discount)[3]
    found = solve(problem, name)
    assert found.primal == pytest.approx(found.dual, abs=1e-8)
    assert np.abs(problem.residual(found.weights)).sum() < 1e-8  # feasible
    assert (found.weights >= 0).all()
    assert problem.replay @ found.weights == pytest.approx(1.0, abs=1e-8)


@pytest.mark.parametrize("name", ["chi2", "kl"])
def test_no_feasible_neighbour_of_the_solution_is_better(name):
    problem = make(1, 3, 0.9)[3]
    best = solve(problem, name)
    _, size, rows = np.linalg.svd((problem.replay[:, None] * problem.flow).T)
    free = rows[int((size > 1e-10).sum()) :]  # directions of w that leave the flow alone
    rng = np.random.default_rng(0)
    for _ in range(20):
        step = rng.normal(size=len(free)) @ free
        for sign in (-1e-2, 1e-2):
            other = best.weights + sign * step
            if (other >= 0).all():
                assert primal_value(problem, other, name) < best.primal
    assert len(free) > 0


@pytest.mark.parametrize("discount", [0.9, 0.99])
def test_kl_weights_are_the_occupancy_ratio(discount):
    problem = make(2, 3, discount)[3]
    found = solve(problem, "kl")
    np.testing.assert_allclose(found.weights, np.exp(problem.log_ratio), rtol=1e-6)
    assert np.ptp(found.q) < 1e-6  # Q is constant


def test_chi2_weights_are_the_ratio_where_dynamics_are_deterministic_and_not_elsewhere():
    deterministic, stochastic = make(2, 1, 0.9)[3], make(2, 3, 0.9)[3]
    ratio = np.exp(deterministic.log_ratio)
    np.testing.assert_allclose(solve(deterministic, "chi2").weights, ratio, rtol=1e-6)
    off = stochastic.replay @ np.abs(
        solve(stochastic, "chi2").weights - np.exp(stochastic.log_ratio)
    )
    assert off > 0.05


@pytest.mark.parametrize("name", ["chi2", "kl"])
def test_the_replays_own_policy_weighs_everything_one(name):
    mdp, target, _, _ = make(3, 3, 0.99)
    problem = OccupancyProblem.of(mdp, target, transition_occupancy(mdp, target))
    np.testing.assert_allclose(solve(problem, name).weights, 1.0, atol=1e-8)


def test_the_optimal_q_is_negative_where_the_episodes_start():
    """Why Q >= 0, as printed in the paper, always binds."""
    for seed in range(4):
        problem = make(seed, 3, 0.9)[3]
        assert problem.inflow @ solve(problem, "chi2").q < 0


def test_dual_value_is_the_learners_dual_term():
    problem = make(0, 3, 0.9)[3]
    uniform = replace(problem, replay=np.full_like(problem.replay, 1 / len(problem.replay)))
    q = np.random.default_rng(0).normal(size=len(problem.inflow))
    y = torch.from_numpy(problem.log_ratio + problem.flow @ q)
    for name in ("chi2", "kl"):
        expected = problem.inflow @ q + float(divergence(name).dual_term(y))
        assert dual_value(uniform, q, name) == pytest.approx(expected)


@pytest.mark.parametrize("name", ["chi2", "kl"])
def test_an_uncovered_policy_has_no_solution(name):
    mdp, target, behaviour, _ = make(0, 3, 0.9)
    replay = transition_occupancy(mdp, behaviour)
    replay[0, 0] = 0  # the policy takes action 0 in state 0, the replay never does
    with pytest.raises(ArithmeticError, match="cover"):
        solve(OccupancyProblem.of(mdp, target, replay / replay.sum()), name)


def test_sampled_transitions_follow_their_distribution():
    mdp, _, behaviour, problem = make(0, 3, 0.9)
    q = transition_occupancy(mdp, behaviour)
    rows, index = sample_transitions(mdp, q, 20_000, np.random.default_rng(1))
    counts = np.zeros(q.shape)
    np.add.at(counts, tuple(index.T), 1)
    assert chisquare(counts[problem.index], problem.replay * 20_000).pvalue > 1e-3
    assert (np.asarray(rows.obs).argmax(1) == index[:, 0]).all()
    assert (np.asarray(rows.action).argmax(1) == index[:, 1]).all()
    assert (np.asarray(rows.next_obs).argmax(1) == index[:, 2]).all()


def test_one_hot_policy_draws_what_its_support_says():
    mdp, target, _, _ = make(0, 3, 0.9)
    policy = OneHotPolicy(torch.from_numpy(target).float())
    obs = torch.from_numpy(sample_starts(mdp, 5, np.random.default_rng(0)))
    actions, probs = policy.support(obs)
    assert actions.shape == (3, 5, 3)
    assert probs.shape == (3, 5)
    drawn = policy(obs, 20_000, torch.Generator().manual_seed(0))
    expected = (probs[..., None] * actions).sum(0)
    torch.testing.assert_close(drawn.mean(0), expected, atol=0.02, rtol=0)
