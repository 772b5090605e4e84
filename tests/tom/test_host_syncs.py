"""What would make a GPU wait for the host, counted on the CPU: the hot loops do none of it."""

from collections import Counter
from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor
from torch.utils._python_dispatch import TorchDispatchMode

from tom.config import ModelConfig, RolloutConfig, SacConfig, TomConfig
from tom.data.replay import ReplayBuffer
from tom.data.scaling import Scaling
from tom.data.transitions import TensorTransitions
from tom.dynamics import make_model
from tom.dynamics.neural import NeuralDynamics
from tom.envs import task
from tom.learners.base import Policy
from tom.learners.discriminator import Discriminator, discriminator_net
from tom.learners.dual import DualProblem, QFunction, q_net
from tom.rollout import roll_out
from tom.sac import Sac
from tom.sac_work import SacUpdates

O, A, B = 4, 2, 32  # noqa: E741
# A value asked for on the host, a shape that depends on values, a host's value sent over.
WAITS = (
    "_local_scalar_dense",
    "item",
    "is_nonzero",
    "equal",
    "nonzero",
    "masked_select",
    "lift_fresh",
)

ARITHMETIC = ("mul", "add", "sub", "mean", "sum", "clamp", "bmm", "baddbmm", "pow")


class Calls(TorchDispatchMode):
    """Counts the calls that a GPU would have to launch, by name."""

    def __init__(self, counted: Callable[[str, tuple[Any, ...]], bool]) -> None:
        super().__init__()
        self.counted = counted
        self.found: Counter[str] = Counter()

    def __torch_dispatch__(
        self,
        func: Any,
        types: Any,
        args: tuple[Any, ...] = (),
        kwargs: dict[str, Any] | None = None,
    ) -> Any:
        name = func.name().removeprefix("aten::").partition(".")[0]
        if self.counted(name, args):
            self.found[name] += 1
        return func(*args, **(kwargs or {}))


def _waits(name: str, args: tuple[Any, ...]) -> bool:
    """Whether a GPU would have to wait for this call."""
    return name in WAITS or (name.startswith("index") and _masked(args))


def _masked(args: tuple[Any, ...]) -> bool:
    indices = args[1] if len(args) > 1 and isinstance(args[1], list | tuple) else ()
    return any(isinstance(i, Tensor) and i.dtype == torch.bool for i in indices)


def waits(call: Callable[[], object]) -> Counter[str]:
    with Calls(_waits) as seen:
        call()
    return seen.found


def generator(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def rows(n: int, obs: int = O, action: int = A) -> TensorTransitions:
    return TensorTransitions.unpack(
        torch.rand(n, 2 * obs + action + 3, generator=generator()), obs, action
    )


def policy() -> Policy:
    return Sac(O, A, SacConfig(hidden=16), [generator()]).member()


def many(kind: Any, members: list[Any]) -> Any:
    """What a fleet steps: one alone as it is, several joined."""
    return members[0] if len(members) == 1 else kind.joined(members)


def test_what_waits_is_noticed():
    x = torch.rand(5)
    assert waits(lambda: float(x.sum()))["_local_scalar_dense"] == 1
    assert waits(lambda: bool((x > 0).all()))
    assert waits(lambda: x[x > 0.5])
    assert waits(lambda: x.new_tensor(1.0))
    assert waits(lambda: torch.nonzero(x))
    assert not waits(lambda: (x * 2).sum().expand(3))


@pytest.mark.parametrize("members", [1, 3])
def test_sac_updates_and_actions(members: int):
    sacs = [Sac(O, A, SacConfig(hidden=16, batch_size=B), [generator(m)]) for m in range(members)]
    joint = many(Sac, sacs)
    works = [SacUpdates(sac, rows(5 * B).packed().view(5, B, -1)) for sac in sacs]
    assert not waits(lambda: SacUpdates.do(works, joint))
    assert not waits(lambda: joint.act(torch.rand(members, 1, O), joint.generators))


@pytest.mark.parametrize("members", [1, 3])
@pytest.mark.parametrize("kind", ["mdn", "ensemble", "mean-ensemble"])
def test_a_step_of_a_models_fit(kind: str, members: int):
    config = ModelConfig.model_validate({"kind": kind, "hidden": 16, "layers": 2, "components": 3})
    models = [make_model(O, A, config, generator(m)) for m in range(members)]
    joint = many(type(models[0]), models)
    assert isinstance(joint, NeuralDynamics)
    x = torch.rand(joint.ensemble, B, O + A)
    y, scale = torch.rand(joint.ensemble, B, 1 + O), torch.rand(joint.ensemble, B, 1)
    assert not waits(lambda: (joint.step(x, y), joint.step(x, y, scale)))


@pytest.mark.parametrize("members", [1, 3])
@pytest.mark.parametrize("penalty", [0.0, 10.0])
def test_a_step_of_the_discriminator(penalty: float, members: int):
    config = TomConfig(discriminator_hidden=16, gradient_penalty=penalty)
    nets = [discriminator_net(O, A, config, generator()) for _ in range(members)]
    joint = many(Discriminator, [Discriminator(net, config) for net in nets])
    drawn = torch.rand(2, members, B, 2 * O + A)
    mix = [torch.rand(members, B, 1)] if penalty else []
    assert not waits(lambda: joint.step(*drawn, *mix))


@pytest.mark.parametrize("members", [1, 3])
def test_a_step_of_the_dual_and_its_minibatches(members: int):
    config = TomConfig(q_hidden=16, q_batch=B, q_steps=9, action_samples=2, q_bias_step=0.1)
    replay = rows(100)
    scaling = Scaling.of((replay.obs, replay.action))
    problem = DualProblem(replay, replay.reward, replay.obs[:9], policy(), config, scaling)
    joint = many(QFunction, [QFunction(q_net(O, A, config, generator()), config)] * members)
    bias_step = torch.full((members,), 0.1)

    def steps() -> None:
        for batch in problem.batches(generator()):
            joint.step(bias_step, *(torch.stack([field] * members) for field in batch.fields()))

    assert not waits(steps)


def test_the_dual_of_many_members_takes_no_more_launches_than_that_of_one():
    config = TomConfig(q_hidden=16, action_samples=2)
    arithmetic = []
    for members in (1, 3):
        q = many(QFunction, [QFunction(q_net(O, A, config, generator()), config)] * members)
        fields = (4 * B, O + A), (2, B), (1, B), (B,), (B,)
        with Calls(lambda name, _: name in ARITHMETIC) as seen:
            q.step(torch.ones(members), *(torch.rand(members, *shape) for shape in fields))
        arithmetic.append(seen.found)
    assert arithmetic[0] == arithmetic[1]
    assert sum(arithmetic[0].values()) > 20


def test_a_minibatch_is_gathered():
    buffer = ReplayBuffer(200, O, A)
    buffer.extend(rows(150))
    assert not waits(lambda: buffer.packed(torch.arange(40)))


def test_a_rollout_asks_once_a_chunk_and_fetches_its_counts_once():
    hopper = task("hopper")
    dims = hopper.obs_dim, hopper.action_dim
    model = make_model(*dims, ModelConfig(hidden=16, layers=2, components=3), generator())
    actor = Sac(*dims, SacConfig(hidden=16), [generator()]).member()
    buffer, config, starts = ReplayBuffer(500, *dims), RolloutConfig(chunk=50), rows(200, *dims).obs

    def play() -> None:
        roll_out(model, actor, hopper.terminated, starts, 1, config, buffer, generator())

    assert waits(play) == {"_local_scalar_dense": 200 // 50}
