from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.stats import chisquare

from tom.learners.terms import DIVERGENCES
from tom.studies.mdp import (
    Array,
    FlowName,
    Mdp,
    OccupancyProblem,
    dual_value,
    occupancy,
    random_mdp,
    random_policy,
    sample_stream,
    sample_transitions,
    solve,
    transition_occupancy,
    with_endings,
)


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


FLOWS = ("discounted", "restart", "stationary")


def ending(
    seed: int, successors: int = 3, states: int = 12, share: float = 0.01
) -> tuple[Mdp, Array, Array]:
    """An MDP where about `share` of the steps end, a policy and the replay's."""
    rng = np.random.default_rng(seed)
    mdp = random_mdp(states, 3, successors, 0.99, rng)
    mdp = with_endings(mdp, share, rng)
    return mdp, random_policy(mdp, rng, uniform=0.1), random_policy(mdp, rng, uniform=0.3)


def collected(seed: int, flow: FlowName, successors: int = 3) -> OccupancyProblem:
    """The problem that online training poses: both buffers are streams as collected."""
    mdp, target, behaviour = ending(seed, successors)
    p, q = (transition_occupancy(mdp, policy, "stationary") for policy in (target, behaviour))
    return OccupancyProblem.of(mdp, target, q, flow, p)


def test_about_the_share_of_steps_that_was_asked_for_ends():
    for share in (0.01, 0.1):
        found = []
        for seed in range(20):
            mdp, policy, _ = ending(seed, share=share)
            assert np.allclose(mdp.transition.sum(2), 1)
            assert mdp.start[-1] == 0
            found.append(transition_occupancy(mdp, policy, "stationary")[..., -1].sum())
        assert np.mean(found) == pytest.approx(share, rel=0.15)
        assert np.std(found) > 0.05 * share


@pytest.mark.parametrize("successors", [1, 3, 12])
def test_the_stationary_occupancy_is_where_the_stream_goes(successors: int):
    mdp, policy, _ = ending(5, successors, share=0.05)
    d = transition_occupancy(mdp, policy, "stationary")
    assert d.sum() == pytest.approx(1.0)
    into = np.where(mdp.terminal, 0.0, d.sum((0, 1))) + d[..., mdp.terminal].sum() * mdp.start
    np.testing.assert_allclose(d.sum((1, 2)), into, atol=1e-12)
    rows, index = sample_stream(mdp, policy, 100_000, np.random.default_rng(0))
    counts = np.zeros(d.shape)
    np.add.at(counts, tuple(index.T), 1)
    assert np.abs(counts / counts.sum() - d).sum() < 0.05
    assert float(np.mean(rows.terminated)) == pytest.approx(d[..., -1].sum(), rel=0.05)


def test_a_stream_goes_on_where_it_was_and_starts_anew_after_an_end():
    mdp, policy, _ = ending(6, share=0.2)
    rows, index = sample_stream(mdp, policy, 20_000, np.random.default_rng(1))
    ended = mdp.terminal[index[:-1, 2]]
    assert (index[1:, 0] == index[:-1, 2])[~ended].all()
    begun = np.bincount(index[1:, 0][ended], minlength=mdp.states)
    expected = mdp.start[:-1] * ended.sum()
    assert chisquare(begun[:-1], expected).pvalue > 1e-3
    assert begun[-1] == 0
    assert (np.asarray(rows.terminated)[:-1] > 0).tolist() == ended.tolist()
    assert (np.asarray(rows.obs).argmax(1) == index[:, 0]).all()


@pytest.mark.parametrize("flow", FLOWS)
@pytest.mark.parametrize("successors", [1, 3])
def test_a_flows_own_occupancy_satisfies_its_constraint(flow: FlowName, successors: int):
    mdp, target, behaviour = ending(7, successors)
    replay = transition_occupancy(mdp, behaviour, "stationary")
    problem = OccupancyProblem.of(mdp, target, replay, flow)
    ratio = np.exp(problem.log_ratio)
    assert np.abs(problem.residual(ratio)).sum() < 1e-12
    mass = problem.replay @ ratio
    if flow == "discounted":
        lost = mdp.discount * (problem.replay * ratio)[mdp.terminal[problem.index[2]]].sum()
        assert mass * (1 - mdp.discount) == pytest.approx(1 - mdp.discount - lost)
        assert mass < 0.9
    else:
        assert mass == pytest.approx(1.0)


@pytest.mark.parametrize("flow", FLOWS)
def test_only_a_stationary_flow_is_satisfied_by_the_stream(flow: FlowName):
    problem = collected(3, flow)
    residual = np.abs(problem.residual(np.exp(problem.log_ratio))).sum()
    assert residual < 1e-12 if flow == "stationary" else residual > 1e-3


@pytest.mark.parametrize("name", ["chi2", "kl"])
@pytest.mark.parametrize("flow", FLOWS)
@pytest.mark.parametrize("seed", range(4))
def test_strong_duality_of_every_flow_where_episodes_end(flow: FlowName, seed: int, name):
    problem = collected(seed, flow)
    found = solve(problem, name)
    assert found.primal == pytest.approx(found.dual, abs=1e-8)
    assert np.abs(problem.residual(found.weights)).sum() < 1e-8
    assert (found.weights >= 0).all()
    loses = flow == "discounted" and name == "chi2"
    mass = problem.replay @ found.weights
    assert mass < 0.9 if loses else mass == pytest.approx(1.0, abs=1e-8)


def test_kl_leaves_nothing_on_ends_where_a_flow_loses_mass_there():
    """Normalised weights satisfy a discounted flow only where nothing ends."""
    problem = collected(0, "discounted")
    mass = problem.replay * solve(problem, "kl").weights
    assert mass[problem.index[2] == problem.index[2].max()].sum() / mass.sum() < 1e-6


def test_a_discounted_flow_fades_the_policys_own_stream_along_the_episode():
    """An episode is 100 steps down a corridor: weights sink as g^t, where they should be one."""
    length = 100
    transition = np.eye(length + 1, k=1)[:, None, :]
    transition[-1, 0, -1] = 1.0
    start, last = np.eye(length + 1)[0], np.eye(length + 1)[-1] > 0
    mdp, policy = Mdp(transition, start, 0.99, last), np.ones((length + 1, 1))
    stream = transition_occupancy(mdp, policy, "stationary")
    weights = {
        flow: solve(OccupancyProblem.of(mdp, policy, stream, flow, stream), "chi2").weights
        for flow in FLOWS
    }
    np.testing.assert_allclose(weights["stationary"], 1.0, atol=1e-8)
    fading = 0.99 ** np.arange(length)
    for flow in ("discounted", "restart"):
        np.testing.assert_allclose(weights[flow] / weights[flow][0], fading, rtol=1e-6)


def test_kl_weights_of_a_stationary_flow_are_the_ratio_of_the_streams():
    problem = collected(2, "stationary")
    np.testing.assert_allclose(solve(problem, "kl").weights, np.exp(problem.log_ratio), rtol=1e-6)


@pytest.mark.parametrize("seed", range(4))
def test_chi_square_takes_weight_from_transitions_that_end_an_episode(seed: int):
    """The discounted flow, p its own occupancy: many of those that end have no weight at all."""
    mdp, target, behaviour = ending(seed, states=20)
    p, q = transition_occupancy(mdp, target), transition_occupancy(mdp, behaviour)
    problem = OccupancyProblem.of(mdp, target, q, made=p)
    weights, ends = solve(problem, "chi2").weights, mdp.terminal[problem.index[2]]
    mass, replay = problem.replay * weights, problem.replay
    share = p[..., -1].sum() / p.sum()
    assert 0.2 * share < mass[ends].sum() / mass.sum() < 0.85 * share
    unheard = weights < 1e-9
    assert 0.2 < replay[ends & unheard].sum() / replay[ends].sum() < 0.8
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
        expected = problem.inflow @ q + float(DIVERGENCES[name].dual_term(y))
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
