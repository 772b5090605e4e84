"""What only a CUDA GPU can show: `pytest -m gpu`, which fails where there is none."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

from tom.config import SacConfig, TomConfig
from tom.dynamics.mdn import Mdn
from tom.events import Event
from tom.fleet import train_fleet
from tom.graphs import WARM_UP, graphed
from tom.learners.discriminator import Discriminator, discriminator_net
from tom.learners.dual import QFunction, q_net
from tom.presets import resolve
from tom.record import RunReader, Store
from tom.run import Stop, train
from tom.sac import Sac
from tom.sweep.plan import Trial

pytestmark = pytest.mark.gpu

O, A, B, M = 11, 3, 64, 3  # noqa: E741
CALLS = WARM_UP + 4


def generator(seed: int, device: str) -> torch.Generator:
    return torch.Generator(device).manual_seed(seed)


def states(make: Callable[[str], Any], inputs: list[list[Tensor]]) -> list[list[Tensor]]:
    """The parameters after the same steps on the CPU, on a GPU, and captured there."""
    found = []
    for device, wrap in (("cpu", False), ("cuda", False), ("cuda", True)):
        subject = make(device)
        step = graphed(subject.step) if wrap else subject.step
        for drawn in inputs:
            step(*(x.to(device) for x in drawn))
        found.append([t.detach().cpu() for t in parameters(subject)])
    return found


def parameters(subject: Any) -> list[Tensor]:
    if isinstance(subject, Sac):
        return [*subject.actor.tensors(), *subject.critic.tensors(), subject.log_temperature]
    return subject.net.tensors()


def same_start(subject: Any, make: Callable[[str], Any]) -> Any:
    """`subject` with the parameters that it would have had on the CPU."""
    subject.load_state_dict(make("cpu").state_dict())
    return subject


def fresh_sac(device: str) -> Sac:
    return Sac(O, A, SacConfig(hidden=32), [generator(m, device) for m in range(M)])


def fresh_mdn(device: str) -> Mdn:
    config = resolve("hopper", "mle", "smoke").model  # pyright: ignore[reportAttributeAccessIssue]
    return Mdn(O, A, config, generator(0, device))


def fresh_discriminator(device: str) -> Discriminator:
    config = TomConfig(discriminator_hidden=32)
    return Discriminator(discriminator_net(O, A, config, generator(0, device)), config)


def fresh_q(device: str) -> QFunction:
    config = TomConfig(q_hidden=32, action_samples=2)
    return QFunction(q_net(O, A, config, generator(0, device)), config)


def draws(*shapes: tuple[int, ...]) -> list[list[Tensor]]:
    g = generator(9, "cpu")
    return [[torch.rand(*shape, generator=g) for shape in shapes] for _ in range(CALLS)]


CASES = {
    "sac": (fresh_sac, draws((M, B, 2 * O + A + 3), (2, M, B, A))),
    "mdn": (fresh_mdn, draws((1, B, O + A), (1, B, 1 + O))),
    "discriminator": (fresh_discriminator, draws((1, B, 2 * O + A), (1, B, 2 * O + A))),
    "q": (fresh_q, draws((1,), (1, 4 * B, O + A), (1, 2, B), (1, 1, B), (1, B), (1, B))),
}


@pytest.mark.parametrize("name", CASES)
def test_a_captured_step_is_the_eager_one_and_the_cpus(name: str):
    fresh, inputs = CASES[name]
    cpu, eager, captured = states(lambda device: same_start(fresh(device), fresh), inputs)
    for a, b, c in zip(cpu, eager, captured, strict=True):
        torch.testing.assert_close(b, c, rtol=1e-4, atol=1e-5)
        torch.testing.assert_close(a, b, rtol=1e-2, atol=1e-3)


def test_a_captured_step_looks_at_its_new_inputs_each_time():
    total = torch.zeros(1, device="cuda")
    add = graphed(lambda x: total.add_(x.sum()))
    for k in range(CALLS):
        add(torch.full((4,), float(k), device="cuda"))
    assert float(total) == 4 * sum(range(CALLS))


def test_no_step_of_a_captured_sac_waits_for_the_device():
    sac = fresh_sac("cuda")
    step = graphed(sac.step)
    for drawn in CASES["sac"][1]:
        step(*(x.cuda() for x in drawn))
    inputs = [x.cuda() for x in CASES["sac"][1][0]]
    torch.cuda.set_sync_debug_mode("error")
    try:
        step(*inputs)
    finally:
        torch.cuda.set_sync_debug_mode("default")


def trial(learner: str, seed: int) -> Trial:
    settings = {"steps": 220, "fit_every": 25, "tom": {"warmup": 20}, "device": "cuda"}
    return Trial("inverted-pendulum", learner, seed, "smoke", settings)


def test_a_member_of_a_fleet_on_a_gpu_is_the_one_trained_alone_there(tmp_path: Path):
    fleet = [trial("mle", 0), trial("tom", 0), trial("tom", 1)]
    found = train_fleet(fleet, Store(tmp_path / "fleet"), rerun=False)
    for own, run in zip(fleet, found, strict=True):
        assert isinstance(run, RunReader), run
        alone = train(own.config, Store(tmp_path / "alone"), own.run_id, rerun=False)
        assert run.status.state == alone.status.state == "finished"
        np.testing.assert_allclose(run.buffer()[0].obs, alone.buffer()[0].obs, rtol=1e-2, atol=1e-2)


def test_a_fleet_on_a_gpu_goes_on_from_its_checkpoints(tmp_path: Path):
    fleet, store, stop = [trial("mle", 0), trial("tom", 0)], Store(tmp_path), Stop()

    def watch(event: Event) -> None:
        if event.env_step == 210 and not stop.asked:
            stop()

    train_fleet(fleet, store, False, [(watch,)] * 2, stop=stop)
    assert {run.status.state for run in store.runs()} == {"stopped"}
    train_fleet(fleet, store, rerun=False)
    assert {(run.status.state, run.status.env_step) for run in store.runs()} == {("finished", 220)}
