"""Policies of other libraries: TorchScript, ONNX and functions, asked as our own are."""

from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
from common import Evil, generator, one_line
from onnx import TensorProto, helper
from torch import Tensor

from tom.envs.gymnasium_task import GymnasiumTask
from tom.envs.termination import never
from tom.errors import UserError
from tom.policy.foreign import ForeignPolicy, foreign_policy, is_foreign

OBS, ACTIONS = 3, 2


def known(scale: float = 1.0, offset: float = 0.0) -> GymnasiumTask:
    """A task whose observations are in another unit."""
    return GymnasiumTask(
        name="known", gym_id="", terminated=never, steps=1, dt=1.0,
        action_dim=ACTIONS, action_low=(-2.0, 0.0), action_high=(2.0, 4.0),
        obs_names=("o",) * OBS, obs_scale=(scale,) * OBS, obs_offset=(offset,) * OBS,
    )  # fmt: skip


class Gaussian(torch.nn.Module):
    """mean (B, 2) is the first two observations; log_std (B, 2) is the third."""

    def forward(self, obs: Tensor) -> tuple[Tensor, Tensor]:
        return obs[:, :2], obs[:, 2:].expand(-1, 2)


class Drawn(torch.nn.Module):
    """Actions in the task's units, drawn by the network itself."""

    def forward(self, obs: Tensor) -> Tensor:
        return torch.randn(obs.shape[0], 2)


def saved(path: Path, network: torch.nn.Module) -> str:
    torch.jit.script(network).save(str(path))
    return str(path)


def exported(path: Path, outputs: int, rows: str | int = "n") -> str:
    """An ONNX file whose every output is the observations' first dimensions."""
    given = helper.make_tensor_value_info("obs", TensorProto.FLOAT, [rows, OBS])
    names = [f"out{i}" for i in range(outputs)]
    limits = [("start", [0]), ("end", [ACTIONS]), ("axis", [1])]
    constants = [helper.make_tensor(n, TensorProto.INT64, [1], v) for n, v in limits]
    slices = [helper.make_node("Slice", ["obs", "start", "end", "axis"], [n]) for n in names]
    made = [helper.make_tensor_value_info(n, TensorProto.FLOAT, [rows, ACTIONS]) for n in names]
    graph = helper.make_graph(slices, "policy", [given], made, constants)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 17)], ir_version=9)
    onnx.save(model, str(path))
    return str(path)


def load(name: str) -> ForeignPolicy:
    assert is_foreign(name)
    return foreign_policy(name, known())


def test_a_gaussian_is_drawn_from_and_squashed(tmp_path: Path):
    policy = load(saved(tmp_path / "policy.pt", Gaussian()))
    obs = torch.tensor([[0.3, -0.6, -1.5], [1.0, 0.0, -30.0]])
    action = policy(obs, 20_000, generator())
    assert action.shape == (20_000, 2, ACTIONS)
    before = torch.atanh(action[:, 0])
    assert before.mean(0).tolist() == pytest.approx([0.3, -0.6], abs=0.01)
    assert before.std(0).tolist() == pytest.approx([np.exp(-1.5)] * 2, rel=0.03)
    assert action[:, 1, 0].tolist() == pytest.approx([np.tanh(1.0)] * 20_000)
    again = policy(obs, 20_000, generator())
    assert torch.equal(action, again)
    assert not torch.equal(action, policy(obs, 20_000, generator(1)))
    assert policy.value_gradient is None


def test_actions_are_in_the_tasks_own_units(tmp_path: Path):
    policy = load(exported(tmp_path / "policy.onnx", outputs=1))
    obs = torch.tensor([[-2.0, 0.0, 0.0], [1.0, 3.0, 0.0], [9.0, -9.0, 0.0]])
    action = policy(obs, 2, generator())
    assert action[0].tolist() == [[-1, -1], [0.5, 0.5], [1, -1]]
    assert torch.equal(action[0], action[1])


def test_onnx_of_a_fixed_batch_is_asked_in_parts(tmp_path: Path):
    policy = load(exported(tmp_path / "policy.onnx", outputs=1, rows=4))
    obs = torch.linspace(0, 2, 7)[:, None] * torch.tensor([1.0, 0.5, 0.0])
    action = policy(obs, 1, generator())[0]
    torch.testing.assert_close(action, torch.stack((obs[:, 0] / 2, obs[:, 1] / 2 - 1), 1))


def test_a_network_is_asked_in_its_own_precision(tmp_path: Path):
    obs, network = torch.eye(OBS), torch.nn.Linear(OBS, ACTIONS)
    asked = [
        load(saved(tmp_path / "policy.pt", network.to(kind)))(obs, 1, generator())
        for kind in (torch.float32, torch.float64)
    ]
    torch.testing.assert_close(*asked)


def test_it_is_asked_in_the_tasks_own_units(tmp_path: Path):
    name = exported(tmp_path / "policy.onnx", outputs=1)
    policy = foreign_policy(name, known(10, 1))
    action = policy(torch.tensor([[0.0, 0.1, 0.0]]), 1, generator())
    assert action.flatten().tolist() == pytest.approx([0.5, 0.0])


def test_two_outputs_of_onnx_are_a_gaussian(tmp_path: Path):
    policy = load(exported(tmp_path / "policy.onnx", outputs=2))
    action = policy(torch.full((1, OBS), -9.0), 5, generator())
    assert action.flatten().tolist() == pytest.approx([-1] * 10)


def test_what_a_file_draws_itself_follows_the_generator(tmp_path: Path):
    policy = load(saved(tmp_path / "policy.ts", Drawn()))
    state = torch.get_rng_state()
    first, second = (policy(torch.zeros(4, OBS), 3, generator()) for _ in range(2))
    assert torch.equal(first, second)
    assert first.unique().numel() > 10
    assert torch.equal(state, torch.get_rng_state())


FUNCTIONS = """
import numpy as np
def act(obs):
    assert isinstance(obs, np.ndarray) and obs.dtype == np.float32
    return np.clip(obs[:, :2], [-2, 0], [2, 4])
def with_state(obs): return act(obs), None
def wide(obs): return obs
def bad(obs): return obs[:, :2] * np.nan
def fails(obs): raise KeyError("nothing here")
"""


def test_a_function_of_numpy_arrays(tmp_path: Path, monkeypatch):
    (tmp_path / "my_policy.py").write_text(FUNCTIONS)
    monkeypatch.chdir(tmp_path)
    for function in ("act", "with_state"):  # as stable-baselines3 answers
        action = load(f"my_policy:{function}")(torch.tensor([[1.0, 1.0, 0.0]]), 1, generator())
        assert action.flatten().tolist() == [0.5, -0.5]
    for function, message in {
        "wide": r"maps observations \(2, 3\) to \(2, 3\): it must return actions \(2, 2\), or",
        "bad": "not finite",
        "fails": "my_policy:fails fails on obs.* .2, 3., .*nothing here.*my_policy.py, line 9",
        "none": "module 'my_policy' has no function 'none'",
    }.items():
        with one_line(message):
            load(f"my_policy:{function}")
    with pytest.raises(UserError, match="no module 'absent': install it, or start from the folder"):
        load("absent:act")


def test_files_that_are_no_policy_are_one_line(tmp_path: Path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    evil = Evil(tmp_path / "executed")
    torch.save({"a": evil}, tmp_path / "checkpoint.pt")
    torch.save(evil, tmp_path / "old.pth", _use_new_zipfile_serialization=False)
    (tmp_path / "text.onnx").write_text("hello")
    for name in ("checkpoint.pt", "old.pth"):
        with pytest.raises(UserError, match=f"{name} is not a TorchScript file"):
            load(name)
    with pytest.raises(UserError, match="is not a usable ONNX file"):
        load("text.onnx")
    with pytest.raises(UserError, match=r"no policy at absent\.pt"):
        load("absent.pt")
    assert not (tmp_path / "executed").exists()
