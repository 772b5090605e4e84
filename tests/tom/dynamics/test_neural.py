from dataclasses import replace
from math import log

import pytest
import torch
from common import generator, present
from torch.distributions import Categorical, MixtureSameFamily, Normal

from tom.config import ModelConfig
from tom.data.scaling import Scaling
from tom.data.transitions import TensorTransitions
from tom.dynamics import make_model
from tom.dynamics.networks import GaussianEnsemble, Mdn, MeanEnsemble, pick_component
from tom.dynamics.neural import NeuralDynamics, _Best, holdout_loss, split

SMALL = ModelConfig(hidden=48, layers=2, components=3, members=3, elites=2, rounds=10, lr=3e-3)


def rows(n: int = 1500, seed: int = 0) -> TensorTransitions:
    g = generator(seed)
    obs = torch.randn(n, 2, generator=g)
    action = torch.rand(n, 1, generator=g) * 2 - 1
    noise = 0.05 * torch.randn(n, 2, generator=g)
    next_obs = obs + 0.3 * action + torch.sin(obs) * 0.1 + noise
    reward = obs[:, 0] * action[:, 0]
    return TensorTransitions(obs, action, reward, next_obs, torch.zeros(n), torch.zeros(n))


def mixture_of(model: Mdn, output: torch.Tensor) -> MixtureSameFamily:
    """The mixture as torch.distributions has it: components last."""
    logits, mean, log_var = (part.mT for part in model._split_output(output))
    return MixtureSameFamily(Categorical(logits=logits), Normal(mean, (0.5 * log_var).exp()))


def test_mdn_likelihood_is_torch_distributions_own():
    model = Mdn(2, 1, SMALL, generator())
    output = torch.randn(1, 7, 3 * 3 * 3)
    target = torch.randn(7, 3)
    mixture = mixture_of(model, output)
    torch.testing.assert_close(model.loss_per_dim(output, target), -mixture.log_prob(target))
    torch.testing.assert_close(model.mean(output), mixture.mean)


@pytest.mark.parametrize("kind", ["mdn", "ensemble", "mean-ensemble"])
def test_a_step_follows_the_slope_of_its_scaled_loss(kind: str, monkeypatch: pytest.MonkeyPatch):
    """The gradient along a direction is the change of the loss there, in double precision."""
    model, g = make_model(2, 1, SMALL.but(kind=kind), generator()), generator(1)
    assert isinstance(model, NeuralDynamics)
    for parameter in model.parameters():
        parameter.data = parameter.data.double()
    x, y, one, all_dims = (
        torch.rand(model.ensemble, 32, width, generator=g).double() for width in (3, 3, 1, 3)
    )
    taken: list[tuple[torch.Tensor, ...]] = []
    monkeypatch.setattr(model.optimiser, "step", taken.append)
    directions = [torch.randn(p.shape, generator=g).double() for p in model.parameters()]

    def moved(by: float) -> float:
        with torch.no_grad():
            for parameter, direction in zip(model.parameters(), directions, strict=True):
                parameter.add_(by * direction)
        loss = model.step(x, y, all_dims, one)
        return float((loss.sum() + model.regulariser()).detach())

    moved(0.0)
    slope = sum(float((a * b).sum()) for a, b in zip(taken[0], directions, strict=True))
    after, before = moved(1e-6), moved(-2e-6)
    assert (after - before) / 2e-6 == pytest.approx(slope, rel=1e-5)


@torch.no_grad()
def test_small_gains_add_up_and_what_is_not_a_number_is_none():
    """A gain is counted from the loss of the last one, as in the authors' code and Janner's."""
    best = _Best(Mdn(2, 1, SMALL, generator()), min_gain=0.01)
    best.keep(torch.tensor([1.0]))  # before the first round: kept, but no gain
    losses = [0.995, 0.991, 0.986, 0.982, 0.98, float("nan"), 0.95]
    gains = [best.update(torch.tensor([loss])) for loss in losses]
    assert gains == [True, False, False, True, False, False, True]
    assert best.losses == torch.tensor([0.95])


@pytest.mark.parametrize("patience", [1, 3])
def test_a_fit_stops_after_more_rounds_than_its_patience(patience: int):
    config = SMALL.but(rounds=20, patience=patience, min_gain=10.0, batches_per_round=2)
    model = make_model(2, 1, config, generator())
    report = model.fit(rows(), torch.ones(1500), None, generator())
    assert report.metrics["model/rounds"] == 1 + patience + 1  # the first counts as a gain


def test_a_component_is_the_one_that_counting_its_shares_gives():
    logits = 3 * torch.randn(2, 40, 5, 7, generator=generator(1))
    u = torch.rand(2, 40, 7, generator=generator(2))
    u[0, 0], u[0, 1] = 0.0, 1 - 2**-24  # all that `torch.rand` can return lies between these
    shares = (logits - logits.amax(-2, keepdim=True)).exp().cumsum(-2)
    wanted = (shares < u[:, :, None] * shares[..., -1:, :]).sum(-2)
    assert torch.equal(pick_component(logits, u), wanted)
    assert wanted.max() == 4
    assert wanted.min() == 0


def test_mdn_recovers_a_two_mode_mixture():
    """next = obs +- 1 with probability 0.3 / 0.7: modes, shares and spread come back."""
    g = generator(3)
    n = 4000
    obs = torch.randn(n, 1, generator=g)
    up = torch.rand(n, 1, generator=g) < 0.3
    step = torch.where(up, 1.0, -1.0) + 0.05 * torch.randn(n, 1, generator=g)
    zeros = torch.zeros(n)
    data = TensorTransitions(obs, torch.zeros(n, 1), zeros, obs + step, zeros, zeros)
    model = Mdn(1, 1, SMALL.but(rounds=12), g)
    model.fit(data, torch.ones(n), None, g)
    probe = torch.zeros(4000, 1)
    change = model.sample(probe, torch.zeros(4000, 1), g)[1][:, 0]
    assert abs(float((change > 0).float().mean()) - 0.3) < 0.05
    assert abs(float(change[change > 0].mean()) - 1) < 0.1
    assert abs(float(change[change < 0].mean()) + 1) < 0.1
    assert float(change[change < 0].std()) < 0.25


@pytest.mark.parametrize("kind", ["mdn", "ensemble", "mean-ensemble"])
def test_fit_predicts_reward_and_next_obs(kind: str):
    data = rows()
    model = make_model(2, 1, SMALL.but(kind=kind), generator())
    model.fit(data, torch.ones(len(data)), None, generator(1))
    test = rows(500, seed=9)
    reward, next_obs = model.predict(test.obs, test.action)
    assert float((next_obs - test.next_obs).square().mean()) < 0.006  # noise alone: 0.0025
    assert float((reward - test.reward).square().mean()) < 0.03  # variance: 0.33


@pytest.mark.parametrize("use", ["sample", "scale"])
def test_weights_decide_what_the_model_learns(use: str):
    """Two laws in one buffer: rows of weight zero teach nothing, in either use of the weights."""
    data = rows(2000)
    wrong = data.next_obs + 2.0
    half = torch.arange(2000) < 1000
    mixed = replace(data, next_obs=torch.where(half.unsqueeze(1), data.next_obs, wrong))
    model = make_model(2, 1, SMALL.but(weights=use), generator())
    model.fit(mixed, 2.0 * half, None, generator(1))
    _, predicted = model.predict(data.obs[half], data.action[half])
    assert float((predicted - data.next_obs[half]).mean().abs()) < 0.05


def test_holdout_rows_keep_their_own_weights():
    """The split permutes rows; a weight must go with its row, not with its place."""
    data = rows(400)
    model = Mdn(2, 1, SMALL.but(rounds=1, batches_per_round=1), generator())
    weights = torch.zeros(400)
    weights[:200] = 2.0
    held = split(400, model.config, generator(5))[1]
    report = model.fit(data, weights, None, generator(5))
    x, y = model.inputs(data[held]), model.scaled_targets(data[held])
    loss = model.loss_per_dim(model.outputs(x), y).mean(-1)[0]
    own = weights[held]
    expected = float((loss * own).sum().detach() / own.sum())
    assert report.metrics["model/holdout_nll"] == pytest.approx(expected, rel=1e-4)


def test_a_fit_whose_weight_is_all_held_out_is_uniform_and_says_so():
    data, config = rows(400), SMALL.but(rounds=2, batches_per_round=20)
    train, held = split(400, config, generator(5))
    found = []
    for only in (train[0], held[0], slice(None)):
        weights = torch.zeros(400)
        weights[only] = 1.0
        model = Mdn(2, 1, config, generator())
        report = model.fit(data, weights / weights.mean(), None, generator(5))
        found.append((model.predict(data.obs, data.action)[1], report.notices))
    (one, none_said), (fallen_back, said), (uniform, _) = found
    assert none_said == ()
    assert [kind for kind, _ in said] == ["fit-unweighted"]
    assert torch.equal(fallen_back, uniform)
    assert not torch.equal(one, uniform)


def test_dimension_weights_leave_the_reward_column_at_one():
    data = rows(1200)
    per_dim = torch.zeros(1200, 2)  # no state dimension counts: only the reward is learnt
    per_dim[:, 1] = 2.0
    model = MeanEnsemble(2, 1, SMALL.but(members=1, elites=1), generator())
    model.fit(data, torch.ones(1200), per_dim, generator(1))
    reward, next_obs = model.predict(data.obs, data.action)
    error = (next_obs - data.next_obs).square().mean(0)
    assert float((reward - data.reward).square().mean()) < 0.03
    assert float(error[1]) < 0.01


def test_elites_are_the_best_by_holdout():
    data = rows(800)
    model = GaussianEnsemble(2, 1, SMALL.but(members=4, elites=2, rounds=4), generator())
    model.fit(data, torch.ones(800), None, generator(4))
    held = split(800, model.config, generator(4))[1]
    x, y = model.inputs(data[held]), model.scaled_targets(data[held])
    losses = holdout_loss(model, x, y, torch.ones(len(held)), None)
    assert set(model.elites.tolist()) == set(losses.argsort()[:2].tolist())


@pytest.mark.parametrize("kind", ["ensemble", "mean-ensemble"])
def test_the_networks_of_the_best_round_are_kept(kind: str):
    """And their bounds of the variance. With so large a step the last round here gained nothing."""
    data = rows(800)
    config = SMALL.but(members=3, elites=3, rounds=8, lr=0.03, batches_per_round=2, patience=8)
    model = make_model(2, 1, config.but(kind=kind), generator())
    assert isinstance(model, NeuralDynamics)
    report = model.fit(data, torch.ones(800), None, generator(4))
    held = split(800, config, generator(4))[1]
    x, y = model.inputs(data[held]), model.scaled_targets(data[held])
    with torch.no_grad():
        losses = holdout_loss(model, x, y, torch.ones(len(held)), None)
    assert float(losses.mean()) == pytest.approx(report.metrics["model/holdout_nll"])


def test_a_constant_dimension_is_centred_and_stays_finite():
    x = torch.stack([torch.full((5,), 3.0), torch.arange(5.0)], 1)
    scaling = Scaling.of((x,))
    z = scaling(x)
    assert torch.equal(z[:, 0], torch.zeros(5))
    torch.testing.assert_close(z[:, 1].std(correction=0), torch.tensor(1.0))
    torch.testing.assert_close(scaling.inverse(z), x)


def test_gaussian_loss_is_the_likelihood_up_to_its_constant():
    model = GaussianEnsemble(2, 1, SMALL, generator())
    output, target = torch.randn(3, 5, 6), torch.randn(5, 3)
    mean, raw = output.chunk(2, -1)
    std = (0.5 * model._log_var(raw)).exp()
    nll = -Normal(mean, std).log_prob(target)
    torch.testing.assert_close(model.loss_per_dim(output, target), 2 * nll - log(2 * torch.pi))


@pytest.mark.parametrize("kind", ["mdn", "ensemble"])
def test_the_likelihood_of_held_out_rows_is_the_reports(kind: str):
    """It is `model/holdout_nll_uniform`, also where all networks are elites, best first."""
    data = rows(300)
    for elites in (2, 3):
        config = SMALL.but(kind=kind, elites=elites, lr=0.03)  # the bounds come to differ
        model = make_model(2, 1, config, generator())
        assert isinstance(model, NeuralDynamics)
        report = model.fit(data, torch.ones(300), None, generator(1))
        held = split(300, config, generator(1))[1]
        nll = present(model.nll(data))
        uniform = report.metrics["model/holdout_nll_uniform"]
        assert uniform == pytest.approx(float(nll[held].mean()), rel=1e-4)
        assert nll.shape == (300, 3)
        output = model.net(model.inputs(data)[None].expand(model.ensemble, -1, -1))
        by_network = model.loss_per_dim(output, model.scaled_targets(data))
        torch.testing.assert_close(
            nll, sum(by_network[k] for k in model.elites) / len(model.elites)
        )
    assert make_model(2, 1, SMALL.but(kind="mean-ensemble"), generator()).nll(data) is None
