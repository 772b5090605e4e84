"""`tom weigh` on data and policies that other libraries made."""

import json
import shutil
from dataclasses import fields
from pathlib import Path

import gymnasium as gym
import numpy as np
import pyarrow.parquet as pq
import pytest
import torch
from commands import refused
from gymnasium.envs.classic_control import PendulumEnv
from gymnasium.wrappers import RescaleAction

from tom.analysis.ordered_data import action_bounds, to_unit_range
from tom.cli import main
from tom.data.transitions import Transitions
from tom.envs import task
from tom.policy.collect import footprint
from tom.policy.stored import UniformPolicy
from tom.record import RunReader
from tom.reports.weighing_files import ROWS, of_run

ENV = "inverted-pendulum"
BOUND = 3.0  # of its actions
N = 300
QUICK = [
    "--preset", "paper", "--tom.q-hidden", "16", "--tom.q-steps", "20", "--seeds", "0",
    "--tom.discriminator-hidden", "16", "--tom.discriminator-steps", "20", "--footprint", "200",
]  # fmt: skip


class Policy(torch.nn.Module):
    """Pushes the cart to where the pole leans, a little at random."""

    def forward(self, obs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        mean = 4.0 * obs[:, 1:2]
        return mean, torch.full_like(mean, -1.0)


class Other(torch.nn.Module):
    """Pushes it away."""

    def forward(self, obs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        mean = -obs[:, 1:2]
        return mean, torch.full_like(mean, -1.0)


@pytest.fixture(scope="module")
def rows() -> Transitions:
    """Random actions in the task, in [-1, 1]."""
    generator = torch.Generator().manual_seed(0)
    return footprint(task(ENV), UniformPolicy(4, 1), N, 0, generator).transitions


@pytest.fixture
def data(rows: Transitions, tmp_path: Path) -> str:
    columns = {field.name: np.asarray(getattr(rows, field.name)) for field in fields(rows)}
    path = tmp_path / "mine.npz"
    np.savez(path, allow_pickle=False, **columns | {"action": columns["action"] * BOUND})
    return str(path)


@pytest.fixture
def policy(tmp_path: Path) -> str:
    path = tmp_path / "policy.pt"
    torch.jit.script(Policy()).save(str(path))
    return str(path)


def weigh(store: Path, *words: str) -> int:
    return main(["weigh", *words, "--store", str(store), *QUICK])


def test_own_data_by_an_own_policy(rows, data: str, policy: str, tmp_path: Path, capsys):
    store = tmp_path / "store"
    assert weigh(store, data, "--policy", policy, "--env", ENV, "--json") == 0
    printed = capsys.readouterr()
    report = json.loads(printed.out)
    made = Path(report["out"])
    assert made.parent == store / "weighings"
    assert made.name.startswith("mine-by-policy.pt-")
    assert (report["data"], report["rows"], report["ordered_from"]) == ("mine", N, 0)
    assert {row["learner"] for row in report["results"]} == {"tom", "pmac", "mle"}
    assert "mine: tom seed 0" in printed.err
    footprints = {row["learner"]: row["footprint"] for row in report["results"]}
    assert footprints["mle"] == 1.0
    assert footprints["pmac"] != 1.0
    weights = pq.read_table(made / "weights.parquet").to_pandas()
    assert weights["tom-s0"].mean() == pytest.approx(1, abs=1e-4)
    kept, version = RunReader(made).buffer()
    for field in fields(rows):
        expected = np.asarray(getattr(rows, field.name))
        np.testing.assert_allclose(getattr(kept, field.name), expected, atol=1e-6)
    assert version.tolist() == list(range(N))
    assert of_run(store, "mine") == []  # it is no run
    assert weigh(store, data, "--policy", "random", "--env", ENV, "--json") == 0
    other = json.loads(capsys.readouterr().out)
    assert other[ROWS] == report[ROWS]


def test_policies_that_collected_the_data_come_from_a_list_or_from_columns(
    rows: Transitions, policy: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    columns = {field.name: np.asarray(getattr(rows, field.name)) for field in fields(rows)}
    columns["action"] = columns["action"] * BOUND
    version = np.repeat([0, 3, 4], N // 3)  # exploration, and two policies

    def command(*words: str, **more: np.ndarray) -> list[str]:
        np.savez(tmp_path / "a.npz", allow_pickle=False, policy_version=version, **columns, **more)
        learner = ["--learner", "policy-distance", "--policy-distance.warmup", "0"]
        asked = ["weigh", str(tmp_path / "a.npz"), "--policy", policy, "--env", ENV]
        return [*asked, "--out", str(tmp_path / "out"), *QUICK, *learner, *words]

    def weights(*words: str, **more: np.ndarray) -> np.ndarray:
        assert main(command(*words, **more)) == 0
        found = pq.read_table(tmp_path / "out/weights.parquet")["policy-distance-s0"].to_numpy()
        shutil.rmtree(tmp_path / "out")
        return found

    other = str(tmp_path / "other.pt")
    torch.jit.script(Other()).save(other)
    listed = weights("--collected-by", other, policy)
    mean = np.where(version[:, None] == 3, -1.0, 4.0) * columns["obs"][:, 1:2]
    of_rows = {"behaviour_mean": mean, "behaviour_log_std": np.full_like(mean, -1.0)}
    np.testing.assert_allclose(listed, weights(**of_rows), rtol=1e-5)
    assert (listed[version == 0] == 0).all()
    # The policy of interest itself is at distance 0: 1 / .05; the other's KL is (5 x / s)^2 / 2.
    divergence = (5 * columns["obs"][:, 1] * np.e) ** 2 / 2
    ratio = (1 / (divergence + 0.05))[version == 3] * 0.05
    np.testing.assert_allclose(listed[version == 3] / listed[-1], ratio, rtol=1e-4)
    assert np.ptp(weights("--collected-by", policy)[version > 0]) < 1e-6
    refused(command(), capsys)
    refused(command("--collected-by", policy, policy, policy), capsys)
    of_rows["behaviour_mean"][N - 1] = np.nan
    refused(command(**of_rows), capsys)


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["--policy", "POLICY"], "does not say which task it is of: add --env"),
        (["--policy", "POLICY", "--env", "hopper"], "has 4 observations and 1 actions, hopper has"),
        (["--policy", "POLICY", "--env", ENV, "--step", "9"], "is a step of a run"),
    ],
)
def test_bad_input_is_one_line_and_nothing_is_made(
    data: str, policy: str, tmp_path: Path, words: list[str], named: str, capsys
):
    given = [{"POLICY": policy, "DATA": data}.get(word, word) for word in words]
    where = ["--store", str(tmp_path / "store")]
    refused(["weigh", data, *given, *where, *QUICK], capsys, named)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["mine.npz", "policy.pt"]


@pytest.mark.parametrize(
    ("factor", "code", "named"),
    [(1.0005, 0, ""), (1.5, 2, "row 7: dimension 0 is 4.5, its bounds are -3 and 3")],
)
def test_actions_outside_the_bounds_are_refused(
    factor: float, code: int, named: str, data: str, tmp_path: Path, capsys
):
    columns = dict(np.load(data))
    columns["action"][7] = BOUND * factor
    np.savez(tmp_path / "far.npz", allow_pickle=False, **columns)
    far, words = str(tmp_path / "far.npz"), ("--policy", "random", "--env", ENV, "--learner", "mle")
    assert weigh(tmp_path / "store", far, *words) == code
    assert named in capsys.readouterr().err
    assert (tmp_path / "store").exists() == (code == 0)


def test_bounds_are_those_of_the_task_as_it_is_registered():
    made = "Rescaled-Pendulum-v0"
    gym.register(made, lambda **_: RescaleAction(PendulumEnv(), np.float32(-1), np.float32(1)))
    known = task(f"gymnasium:{made}")  # the innermost Pendulum's bounds are -2 and 2
    action = np.array([[-1.0], [0.0], [0.5]], np.float32)
    np.testing.assert_array_equal(to_unit_range(action, known), action)
    assert [bound.tolist() for bound in action_bounds(known)] == [[-1.0], [1.0]]
