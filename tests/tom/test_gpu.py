"""Steps on a CUDA GPU: on one made of the CPU, and with `pytest -m gpu` on a real one."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from tom.config import ModelConfig, SacConfig, TomConfig
from tom.data.sampling import WeightedSampler
from tom.dynamics import make_model
from tom.dynamics.neural import NeuralDynamics
from tom.learners.discriminator import Discriminator, discriminator_net
from tom.learners.dual import QFunction, q_net
from tom.nn.graphs import WARM_UP, graphed
from tom.policy.sac import Sac
from tom.record import checkpoint
from tom.rng import Streams, normal

pytestmark = pytest.mark.usefixtures("gpu")

O, A, B, M, E = 11, 3, 64, 3, 2  # noqa: E741
CALLS = WARM_UP + 4

Fresh = Callable[[torch.Generator], Any]


@dataclass(frozen=True)
class Case:
    """A subject of steps, one alone or those of M members joined, and shapes of what it takes."""

    fresh: Fresh
    shapes: Sequence[tuple[int, ...]]
    members: int = 1

    def subject(self, device: str) -> Any:
        """With the parameters that it has on the CPU."""
        own = []
        for seed in range(self.members):
            one = self.fresh(generator(seed, device))
            one.load_state_dict(self.fresh(generator(seed, "cpu")).state_dict())
            own.append(one)
        return own[0] if len(own) == 1 else type(own[0]).joined(own)

    def draws(self) -> list[list[Tensor]]:
        g = generator(9, "cpu")
        return [[torch.rand(*shape, generator=g) for shape in self.shapes] for _ in range(CALLS)]


def generator(seed: int, device: str) -> torch.Generator:
    return torch.Generator(device).manual_seed(seed)


def sac(g: torch.Generator) -> Sac:
    return Sac(O, A, SacConfig(hidden=32), [g])


def model(kind: str) -> Fresh:
    config = ModelConfig.model_validate({"kind": kind, "hidden": 32, "layers": 2, "members": E})
    return lambda g: make_model(O, A, config, g)


def discriminator(penalty: float) -> Fresh:
    config = TomConfig(discriminator_hidden=32, gradient_penalty=penalty)
    return lambda g: Discriminator(discriminator_net(O, A, config, g), config)


def q_function(g: torch.Generator) -> QFunction:
    config = TomConfig(q_hidden=32, action_samples=2, q_bias_step=0.1)
    return QFunction(q_net(O, A, config, g), config)


def of_sac(m: int) -> list[tuple[int, ...]]:
    return [(m, B, 2 * O + A + 3), (2, m, B, A)]


def of_model(m: int, *scales: int) -> list[tuple[int, ...]]:
    return [(m, B, O + A), (m, B, 1 + O), *((m, B, scale) for scale in scales)]


def of_discriminator(m: int) -> list[tuple[int, ...]]:
    return [(m, B, 2 * O + A)] * 2


def of_q(m: int) -> list[tuple[int, ...]]:
    return [(m,), (m, 4 * B, O + A), (m, 2, B), (m, 1, B), (m, B), (m, B)]


CASES = {
    "sac": Case(sac, of_sac(1)),
    "sac of a fleet": Case(sac, of_sac(M), M),
    "mdn": Case(model("mdn"), of_model(1)),
    "mdn, loss scaled": Case(model("mdn"), of_model(1, 1 + O, 1)),
    "mdn of a fleet": Case(model("mdn"), of_model(M), M),
    "ensemble": Case(model("ensemble"), of_model(E)),
    "ensemble of a fleet": Case(model("ensemble"), of_model(M * E), M),
    "mean-ensemble": Case(model("mean-ensemble"), of_model(E, 1 + O)),
    "discriminator": Case(discriminator(0.0), of_discriminator(1)),
    "discriminator, penalty": Case(discriminator(10.0), [*of_discriminator(1), (1, B, 1)]),
    "discriminator of a fleet": Case(discriminator(0.0), of_discriminator(M), M),
    "q": Case(q_function, of_q(1)),
    "q of a fleet": Case(q_function, of_q(M), M),
}


def moved(subject: Any) -> list[Tensor]:
    """What a step moves: networks, what stands outside them, and what their optimisers keep."""
    if isinstance(subject, Sac):
        nets = subject.actor, subject.critic, subject.target_critic
        optimisers = subject.actor_optimiser, subject.critic_optimiser
        networks = [subject.log_temperature, *(t for net in nets for t in net.tensors())]
        return [*networks, *(t for one in optimisers for t in one.tensors())]
    extra = subject.extra_parameters() if isinstance(subject, NeuralDynamics) else []
    return [*subject.net.tensors(), *extra, *subject.optimiser.tensors()]


def after(case: Case, device: str, wrap: Callable[[Any], Any]) -> list[Tensor]:
    """What has been moved after a few steps."""
    subject = case.subject(device)
    step = wrap(subject.step)
    for drawn in case.draws():
        step(*(x.to(device) for x in drawn))
    return [t.detach().cpu() for t in moved(subject)]


@pytest.mark.parametrize("name", CASES)
def test_a_captured_step_is_the_eager_one_and_the_cpus(name: str):
    case = CASES[name]
    cpu, eager = after(case, "cpu", lambda step: step), after(case, "cuda", lambda step: step)
    for a, b, c in zip(cpu, eager, after(case, "cuda", graphed), strict=True):
        torch.testing.assert_close(b, c, rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(a, b, rtol=1e-2, atol=1e-3)


@pytest.mark.parametrize("name", CASES)
def test_no_captured_step_waits_for_the_device_or_takes_more_memory(name: str):
    step, drawn = graphed(CASES[name].subject("cuda").step), CASES[name].draws()
    for inputs in drawn:
        step(*(x.cuda() for x in inputs))
    again = [x.cuda() for x in drawn[0]]
    held = torch.cuda.memory_allocated()
    torch.cuda.set_sync_debug_mode("error")
    try:
        for _ in range(3):
            step(*again)
    finally:
        torch.cuda.set_sync_debug_mode("default")
    assert torch.cuda.memory_allocated() == held


def assert_it_adds(device: str) -> None:
    total = torch.zeros(1, device=device)
    add = graphed(lambda x: total.add_(x.sum()))
    for k in range(CALLS):
        add(torch.full((4,), float(k), device=device))
    assert float(total) == 4 * sum(range(CALLS))


def test_a_captured_step_looks_at_its_new_inputs_each_time():
    assert_it_adds("cuda")


def test_a_step_on_a_gpu_that_is_not_the_current_one_is_captured_there():
    """Elsewhere nothing would be recorded, and no error would say so."""
    if torch.cuda.device_count() < 2:
        pytest.skip("there is one GPU")
    assert_it_adds("cuda:1")


def test_a_member_draws_the_same_in_any_company_and_after_a_checkpoint(tmp_path: Path):
    streams = Streams(3, "cuda")
    beside = normal([generator(0, "cuda"), streams.torch("a")], (500,))[1]
    assert torch.equal(normal([Streams(3, "cuda").torch("a")], (500,))[0], beside)
    checkpoint.save(tmp_path, 1, {"streams": streams.state_dict(), "drawn": beside})
    held = checkpoint.load(tmp_path)
    assert held is not None
    assert held.state["drawn"].device.type == "cpu"  # to be read where there is no GPU
    other = Streams(4, "cuda")
    other.load_state_dict(held.state["streams"])
    assert torch.equal(normal([other.torch("a")], (9,)), normal([streams.torch("a")], (9,)))


def test_rows_are_drawn_by_weight():
    weights = torch.tensor([0.0, 1.0, 0.0, 3.0], device="cuda").repeat(1000)
    drawn = WeightedSampler(weights, generator(0, "cuda")).draw(100_000) % 4
    assert set(drawn.tolist()) == {1, 3}
    assert abs(float((drawn == 3).float().mean()) - 0.75) < 0.01
