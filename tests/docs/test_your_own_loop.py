"""docs/your-own-loop.md: its scripts are run, and its example."""

import os
import re
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import tom
from tom.frames import Run
from tom.record import RunReader

DOCS = Path(__file__).parents[2] / "docs"
BLOCKS = re.findall(r"```python\n(.*?)```", (DOCS / "your-own-loop.md").read_text(), re.DOTALL)
SCRIPTS = [block for block in BLOCKS if "model.learn" in block]
FEW = {
    "learning_starts=500": "learning_starts=100",
    "learn(6000": "learn(400",
    "every=1000": "every=100",
}
PATIENCE_S = 120


def run_script(text: str, folder: Path, *words: str) -> None:
    (folder / "train.py").write_text(text)
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "train.py", *words], cwd=folder, env=environment, capture_output=True,
        text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert not done.stderr, done.stderr


def ended(folder: Path, name: str) -> Run:
    """The run, when its live weighings, one of TOM among them, have begun and ended."""
    begun, run = time.monotonic(), RunReader(folder / "runs" / name)
    while "tom" not in run.live() or any(
        live.status.state in ("running", "unknown") for live in run.live().values()
    ):
        assert time.monotonic() - begun < PATIENCE_S
        time.sleep(0.1)
    found = tom.load(name, store=folder / "runs")
    assert isinstance(found, Run)
    assert {str(one.summary["state"]) for one in (found, *found.live.values())} == {"finished"}
    return found


@pytest.mark.parametrize(
    ("script", "name"),
    [(SCRIPTS[0], "my-sac"), pytest.param(SCRIPTS[1], "weighted-sac", marks=pytest.mark.slow)],
)
def test_the_trainings_of_the_page(script: str, name: str, tmp_path: Path):
    for many, few in FEW.items():
        assert many in script
        script = script.replace(many, few)
    run_script(script, tmp_path)
    run = ended(tmp_path, name)
    live = run.live["tom"]
    assert len(run.transitions) == 400
    assert run.reader.policy_steps() == run.reader.evaluation_steps() == [100, 200, 300, 400]
    assert live.reader.snapshot_steps()[-1] == 400


@pytest.mark.slow
def test_the_example(tmp_path: Path):
    run_script((DOCS / "examples/ddpg_loop.py").read_text(), tmp_path, "700")
    run = ended(tmp_path, "my-ddpg")
    rows = run.rows(700)
    assert len(rows) == 700
    assert len(np.unique(rows["weight"])) > 100
    assert run.reader.evaluation_steps() == [700]
    assert [*run.live] == ["pmac", "tom"]
