"""GPUs made of the CPU: what they refuse, what they replay, and that a training there is right."""

import gc
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager
from functools import partial
from pathlib import Path
from typing import cast

import numpy as np
import pytest
import torch
from gpus import GpuError, Gpus, Graph, Stream, emulated
from torch import Tensor

from tom.config import SacConfig
from tom.dynamics import fitting
from tom.learners import discriminator, dual
from tom.nn.adam import Adam
from tom.nn.graphs import WARM_UP
from tom.nn.lockstep import Lockstep, do
from tom.policy.sac import Sac
from tom.policy.sac_work import SacUpdates
from tom.record import RunReader, Store
from tom.training.fleet import train_fleet
from tom.training.plan import Trial


@pytest.fixture
def gpus() -> Iterator[Gpus]:
    with emulated() as made:
        yield made


def there(*values: float, index: int = 0) -> Tensor:
    return torch.tensor(values, dtype=torch.float32, device=f"cuda:{index}")


def new_graph() -> Graph:
    return cast(Graph, torch.cuda.CUDAGraph())


def capture(gpus: Gpus, graph: Graph) -> AbstractContextManager[None]:
    return gpus.graph(graph, Stream("cuda"))


@pytest.mark.parametrize(
    "call",
    [
        lambda x: x + torch.ones(3),
        lambda x: x + torch.ones(3, device="cuda:1"),
        lambda x: torch.stack([x, torch.ones(3)]),
        lambda x: torch.stack([x.sum(), torch.tensor(1.0)]),
        lambda x: x.index_select(0, torch.tensor([1])),
        lambda x: torch.rand(3, device="cuda", generator=torch.Generator()),
        lambda x: torch.rand(3, device="cuda:1", generator=torch.Generator("cuda")),
        lambda x: x.normal_(generator=torch.Generator()),
        lambda x: Adam([x.clone()], lr=0.1).step([torch.ones(3)]),
    ],
)
def test_two_devices_in_one_call_are_refused(gpus: Gpus, call: Callable[[Tensor], object]):
    with pytest.raises(GpuError, match=r"same device|generator"):
        call(there(1, 2, 3))


@pytest.mark.parametrize("call", [Tensor.numpy, np.asarray])
def test_numpy_takes_no_gpus_tensor(gpus: Gpus, call: Callable[[Tensor], object]):
    with pytest.raises(TypeError, match="numpy"):
        call(there(1))


@pytest.mark.parametrize(
    ("call", "what"),
    [
        (lambda x: float(x.sum()), "_local_scalar_dense"),
        (lambda x: bool((x > 0).all()), "_local_scalar_dense"),
        (lambda x: x.tolist(), "tolist"),
        (lambda x: x[x > 0.5], "index"),
        (lambda x: x[torch.tensor([0])], "index"),
        (lambda x: torch.nonzero(x), "nonzero"),
        (lambda x: x.cpu(), "_to_copy"),
        (lambda x: x.copy_(torch.ones(3)), "copy_"),
        (lambda x: x.new_tensor(1.0), "_to_copy"),
    ],
)
def test_what_waits_is_noticed_and_no_capture_allows_it(
    gpus: Gpus, call: Callable[[Tensor], object], what: str
):
    x = there(1, 2, 3)
    before = gpus.waits.copy()
    call(x)
    assert gpus.waits - before == {what: 1}
    with (
        pytest.raises(GpuError, match="capturing"),
        capture(gpus, new_graph()),
    ):
        call(x)


def test_what_does_not_wait_is_not_counted(gpus: Gpus):
    x = there(1, 2, 3)
    before, launched = gpus.waits.copy(), gpus.launches.copy()
    (x * 2)[1:].sum().expand(3)
    torch.ones(3).copy_(x, non_blocking=True)
    assert not gpus.waits - before
    assert gpus.launches - launched == {"mul": 1, "sum": 1, "copy_": 1}  # views are none


def test_a_graph_is_its_calls_on_its_own_memory(gpus: Gpus):
    x, total, factor = there(1, 2), there(0), 10.0
    graph = new_graph()
    with capture(gpus, graph):
        y = x * factor
        total.add_(y[1:].sum())
    assert total.tolist() == [0]  # captured, and not run
    factor = 20.0
    for new in (there(3, 4), there(5, 6)):
        x.copy_(new)
        graph.replay()
    assert y.tolist() == [50, 60]  # the factor is the captured one
    assert total.tolist() == [100]
    x = there(0, 0)
    graph.replay()
    assert y.tolist() == [50, 60]  # and so is the memory


def test_a_graph_knows_no_generator(gpus: Gpus):
    graph = new_graph()
    with (
        pytest.raises(GpuError, match="generator"),
        capture(gpus, graph),
    ):
        torch.rand(3, generator=torch.Generator("cuda"), device="cuda")


def test_the_memory_of_a_capture_goes_when_its_members_part(gpus: Gpus):
    """Without waiting for the garbage collector: nothing else of a GPU's is made meanwhile."""
    held: dict[str, int] = {}

    def training(number: int, updates: int) -> None:
        sac = Sac(3, 1, SacConfig(hidden=16), [torch.Generator("cuda").manual_seed(number)])
        batches = torch.rand(1, 32, 10).cuda()
        for update in range(updates):
            do(SacUpdates(sac, batches))
            if number == 0:
                held["captured" if update == WARM_UP else "parted"] = gpus.memory_allocated()

    gc.disable()
    try:
        Lockstep().run([partial(training, 0, WARM_UP + 2), partial(training, 1, WARM_UP + 1)])
    finally:
        gc.enable()
    assert held["parted"] < 0.5 * held["captured"]


def rows(run: RunReader | Exception) -> np.ndarray:
    assert isinstance(run, RunReader), run
    assert run.status.state == "finished"
    buffer = run.buffer()[0]
    return np.column_stack([buffer.obs, buffer.action, buffer.reward, buffer.next_obs])


def test_a_fleet_on_a_gpu_is_to_the_bit_the_trainings_on_the_cpu(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """All that is captured, joined and sent over: TOM's, each kind of model's, VaGram's, SAC's."""
    for module in (dual, discriminator, fitting):  # draw as many minibatches at once
        monkeypatch.setattr(module, "GPU_BLOCK", module.BLOCK)

    def fleet(device: str) -> list[Trial]:
        settings = {"steps": 225, "fit_every": 10, "tom": {"warmup": 5}, "device": device}
        more = [
            ("tom", {}),
            ("tom", {}),
            ("tom", {"tom": {"warmup": 5, "gradient_penalty": 10.0, "parameter_average": 0.9}}),
            ("pmac", {"model": {"kind": "ensemble"}}),
            ("vagram", {}),
            ("mle", {"rollout": {"length": 2, "final_length": 2, "starts": 200}}),
        ]
        return [
            Trial("inverted-pendulum", learner, seed, "smoke", settings | changed)
            for seed, (learner, changed) in enumerate(more)
        ]

    with emulated() as gpus:
        on_gpus = train_fleet(fleet("cuda"), Store(tmp_path / "gpu"), rerun=False)
    assert gpus.launches.total() > 10_000
    on_cpu = train_fleet(fleet("cpu"), Store(tmp_path / "cpu"), rerun=False)
    for one, other in zip(on_gpus, on_cpu, strict=True):
        assert np.array_equal(rows(one), rows(other))
