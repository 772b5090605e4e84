"""The hot loops never make a GPU wait for the host: counted on GPUs made of the CPU."""

from collections import Counter
from collections.abc import Callable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest
import torch
from gpus import Gpus, emulated

from tom.config import ModelConfig, RolloutConfig, SacConfig, TomConfig
from tom.data.replay import ReplayBuffer
from tom.data.scaling import Scaling
from tom.data.transitions import TensorTransitions
from tom.dynamics import make_model
from tom.dynamics.neural import NeuralDynamics
from tom.envs import task
from tom.events import Event, Tick
from tom.learners.base import Policy
from tom.learners.discriminator import Discriminator, discriminator_net
from tom.learners.dual import DualProblem, QFunction, q_net
from tom.nn import mlp
from tom.policy.rollout import roll_out
from tom.policy.sac import Sac
from tom.policy.sac_work import SacUpdates
from tom.record import Store
from tom.training.fleet import train_fleet
from tom.training.plan import Trial

O, A, B = 4, 2, 32  # noqa: E741
GPU = "cuda"


@pytest.fixture(autouse=True)
def gpus() -> Iterator[Gpus]:
    with emulated() as made:
        yield made


def waits(gpus: Gpus, call: Callable[[], object]) -> Counter[str]:
    before = gpus.waits.copy()
    call()
    return gpus.waits - before


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator(GPU).manual_seed(seed)


def rows(n: int, obs: int = O, action: int = A) -> TensorTransitions:
    width = 2 * obs + action + 3
    return TensorTransitions.unpack(
        torch.rand(n, width, generator=generator(), device=GPU), obs, action
    )


def policy() -> Policy:
    return Sac(O, A, SacConfig(hidden=16), [generator()]).member()


def many(kind: Any, members: list[Any]) -> Any:
    """What a fleet steps: one alone as it is, several joined."""
    return members[0] if len(members) == 1 else kind.joined(members)


@pytest.mark.parametrize("members", [1, 3])
def test_sac_updates_and_actions(gpus: Gpus, members: int):
    sacs = [Sac(O, A, SacConfig(hidden=16, batch_size=B), [generator(m)]) for m in range(members)]
    joint = many(Sac, sacs)
    works = [SacUpdates(sac, rows(5 * B).packed().view(5, B, -1)) for sac in sacs]
    obs = torch.rand(members, 1, O, device=GPU)
    assert not waits(gpus, lambda: SacUpdates.do(works, joint))
    assert not waits(gpus, lambda: joint.act(obs, joint.generators))


@pytest.mark.parametrize("members", [1, 3])
@pytest.mark.parametrize("kind", ["mdn", "ensemble", "mean-ensemble"])
def test_a_step_of_a_models_fit(gpus: Gpus, kind: str, members: int):
    config = ModelConfig.model_validate({"kind": kind, "hidden": 16, "layers": 2, "components": 3})
    models = [make_model(O, A, config, generator(m)) for m in range(members)]
    joint = many(type(models[0]), models)
    assert isinstance(joint, NeuralDynamics)
    nets = joint.ensemble
    x, y = (torch.rand(nets, B, width, device=GPU) for width in (O + A, 1 + O))
    scale = torch.rand(nets, B, 1, device=GPU)
    assert not waits(gpus, lambda: (joint.step(x, y), joint.step(x, y, scale)))


@pytest.mark.parametrize("members", [1, 3])
@pytest.mark.parametrize("penalty", [0.0, 10.0])
def test_a_step_of_the_discriminator(gpus: Gpus, penalty: float, members: int):
    config = TomConfig(discriminator_hidden=16, gradient_penalty=penalty)
    nets = [discriminator_net(O, A, config, generator()) for _ in range(members)]
    joint = many(Discriminator, [Discriminator(net, config) for net in nets])
    drawn = torch.rand(2, members, B, 2 * O + A, device=GPU)
    mix = [torch.rand(members, B, 1, device=GPU)] if penalty else []
    assert not waits(gpus, lambda: joint.step(*drawn, *mix))


@pytest.mark.parametrize("members", [1, 3])
def test_a_step_of_the_dual_and_its_minibatches(gpus: Gpus, members: int):
    config = TomConfig(q_hidden=16, q_batch=B, q_steps=9, action_samples=2, q_bias_step=0.1)
    replay = rows(100)
    scaling = Scaling.of((replay.obs, replay.action))
    problem = DualProblem(replay, replay.reward, replay.obs[:9], policy(), config, scaling)
    joint = many(QFunction, [QFunction(q_net(O, A, config, generator()), config)] * members)
    bias_step = torch.full((members,), 0.1, device=GPU)

    def steps() -> None:
        for batch in problem.batches(generator()):
            joint.step(bias_step, *(torch.stack([field] * members) for field in batch.fields()))

    assert not waits(gpus, steps)


def test_the_dual_of_many_members_takes_no_more_launches_than_that_of_one(gpus: Gpus):
    config = TomConfig(q_hidden=16, action_samples=2)
    shapes = (4 * B, O + A), (2, B), (1, B), (B,), (B,)
    launches = []
    for members in (1, 3):
        q = many(QFunction, [QFunction(q_net(O, A, config, generator()), config)] * members)
        fields = [torch.rand(members, *shape, device=GPU) for shape in shapes]
        bias_step = torch.ones(members, device=GPU)
        before = gpus.launches.copy()
        q.step(bias_step, *fields)
        launches.append(gpus.launches - before)
    assert launches[0] == launches[1]
    assert launches[0].total() > 30


def test_a_minibatch_is_gathered(gpus: Gpus):
    buffer = ReplayBuffer(200, O, A, GPU)
    buffer.extend(rows(150))
    index = torch.arange(40, device=GPU)
    assert not waits(gpus, lambda: buffer.packed(index))


def test_a_rollout_asks_once_a_chunk_and_fetches_its_counts_once(
    gpus: Gpus, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr(mlp, "GPU_ROWS", 50)
    hopper = task("hopper")
    dims = hopper.obs_dim, hopper.action_dim
    model = make_model(*dims, ModelConfig(hidden=16, layers=2, components=3), generator())
    actor = Sac(*dims, SacConfig(hidden=16), [generator()]).member()
    config, starts = RolloutConfig(chunk=50), rows(200, *dims).obs
    buffer = ReplayBuffer(500, *dims, GPU)

    def play() -> None:
        roll_out(model, actor, hopper.terminated, starts, 1, config, buffer, generator())

    assert waits(gpus, play) == {"_local_scalar_dense": 200 // 50, "tolist": 1}


@pytest.mark.parametrize("members", [2, 5])
def test_launches_and_waits_of_an_env_step(gpus: Gpus, members: int, tmp_path: Path):
    """What docs/speed.md says of it; each step, once its graphs are captured."""
    seen: list[tuple[int, int]] = []

    def watch(event: Event) -> None:
        if isinstance(event, Tick) and event.phase == "optimise":
            seen.append((gpus.launches.total(), gpus.waits.total()))

    settings = {"steps": 220, "exploration_steps": 200, "fit_every": 40, "updates_per_step": 5}
    fleet = [
        Trial("inverted-pendulum", "mle", seed, "smoke", {**settings, "device": GPU})
        for seed in range(members)
    ]
    train_fleet(fleet, Store(tmp_path), False, [(watch,), *[()] * (members - 1)])
    steps = {(b - a, d - c) for (a, c), (b, d) in pairwise(seen[:-1])}  # the last one evaluates
    assert steps == {(9 * members + 38, members + 2)}
