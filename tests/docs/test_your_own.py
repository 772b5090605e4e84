"""docs/your-own.md: its lines are run, and what they export is what the model learnt from."""

import importlib.util
import json
import os
import re
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import gymnasium
import numpy as np
import pytest
import torch
from stable_baselines3 import SAC

from tom.cli import main
from tom.data.datasets import read_dataset

PAGE = (Path(__file__).parents[2] / "docs/your-own.md").read_text()
FILES = {
    name: re.search(rf"`{name}`:\n\n```python\n(.*?)```", PAGE, re.DOTALL)
    for name in ("export.py", "train.py")
}
(WEIGH,) = re.findall(r"^tom (weigh .*)$", PAGE, re.MULTILINE)
QUICK = [
    "--preset", "paper", "--tom.q-hidden", "16", "--tom.q-steps", "20", "--seeds", "0", "--json",
    "--tom.discriminator-hidden", "16", "--tom.discriminator-steps", "20", "--footprint", "100",
]  # fmt: skip
STEPS = "learning_starts=500", "learn(4000)"
FEW = "learning_starts=100", "learn(150)"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The page's files, in the folder that commands are called in."""
    for name, found in FILES.items():
        assert found, f"the page has no {name}"
        (tmp_path / name).write_text(found[1])
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def export(folder: Path) -> ModuleType:
    spec = importlib.util.spec_from_file_location("export", folder / "export.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def train(folder: Path) -> None:
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "train.py"], cwd=folder, env=environment, capture_output=True, text=True,
        check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr


class Watched(gymnasium.Wrapper):
    """Notes every step that is taken."""

    def __init__(self, env: gymnasium.Env) -> None:
        super().__init__(env)
        self.steps: list[tuple] = []
        self._obs = np.zeros(0)

    def reset(self, **options):
        self._obs, info = self.env.reset(**options)
        return self._obs, info

    def step(self, action):
        found = self.env.step(action)
        self.steps.append((self._obs, np.array(action), *found[:4]))
        self._obs = found[0]
        return found


@pytest.mark.parametrize(("env", "limit"), [("Pendulum-v1", 40), ("InvertedPendulum-v5", 30)])
def test_the_exported_buffer_is_what_was_done(export: ModuleType, env: str, limit: int):
    watched = Watched(gymnasium.make(env, max_episode_steps=limit))
    model = SAC(
        "MlpPolicy", watched, learning_starts=90, buffer_size=75, batch_size=16, seed=0,
        policy_kwargs={"net_arch": [8]},
    )  # fmt: skip
    model.learn(110)
    export.export_buffer(model, "buffer.npz")
    rows = read_dataset("buffer.npz").rows
    done = [np.array(part) for part in zip(*watched.steps[-75:], strict=True)]
    obs, action, next_obs, reward, terminated, truncated = done
    truncated[-1] = not terminated[-1]  # the recording stops there
    np.testing.assert_allclose(rows.obs, obs, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(rows.action, action, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(rows.next_obs, next_obs, rtol=1e-5, atol=1e-6)
    np.testing.assert_allclose(rows.reward, reward, rtol=1e-5, atol=1e-6)
    np.testing.assert_array_equal(rows.terminated, terminated)
    np.testing.assert_array_equal(rows.truncated, truncated & ~terminated)
    assert np.abs(action).max() > 1  # in the task's own units


def test_the_exported_policy_is_the_models(export: ModuleType):
    env = gymnasium.make("Pendulum-v1")
    model = SAC("MlpPolicy", env, seed=0, policy_kwargs={"net_arch": [8]})
    export.export_policy(model, "policy.pt")
    obs = np.random.default_rng(0).normal(size=(5, 3)).astype(np.float32)
    mean, log_std = torch.jit.load("policy.pt")(torch.from_numpy(obs))
    expected = model.predict(obs, deterministic=True)[0]
    np.testing.assert_allclose(2 * np.tanh(mean.detach()), expected, atol=1e-5)
    assert log_std.shape == mean.shape == (5, 1)


def test_the_page_in_few_steps(folder: Path, capsys: pytest.CaptureFixture):
    script = (folder / "train.py").read_text()
    for many, few in zip(STEPS, FEW, strict=True):
        assert many in script
        script = script.replace(many, few)
    (folder / "train.py").write_text(script)
    train(folder)
    assert main([*WEIGH.split(), *QUICK]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["rows"] == 150
    assert {row["learner"] for row in report["results"]} == {"tom", "pmac", "mle"}


@pytest.mark.slow
def test_the_page_as_it_stands(folder: Path):
    train(folder)
    assert main(WEIGH.split()) == 0
    (made,) = (folder / "runs" / "weighings").iterdir()
    results = json.loads((made / "report.json").read_text())["results"]
    footprint = {row["learner"]: row["footprint"] for row in results}
    assert footprint["mle"] == 1.0
    assert footprint.keys() == {"tom", "pmac", "mle"}
