"""docs/your-own.md and your-own-loop.md: their scripts are run, and the example."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from commands import QUICK
from kernel import wait_for
from loops import loaded

from tom.cli import main
from tom.frames import Run
from tom.record import RunReader

DOCS = Path(__file__).parents[2] / "docs"
PAGE = (DOCS / "your-own.md").read_text()
(SCRIPT,) = re.findall(r"`train.py`:\n\n```python\n(.*?)```", PAGE, re.DOTALL)
(WEIGH,) = re.findall(r"^tom (weigh .*)$", PAGE, re.MULTILINE)
BLOCKS = re.findall(r"```python\n(.*?)```", (DOCS / "your-own-loop.md").read_text(), re.DOTALL)
SCRIPTS = [block for block in BLOCKS if "model.learn" in block]
FEW = {
    "learning_starts=500": "learning_starts=100",
    "learn(6000": "learn(400",
    "every=1000": "every=100",
    "learn(4000": "learn(150",
}
PATIENCE_S = 120


def run_script(text: str, folder: Path, *words: str) -> None:
    """The script in fewer steps, in a process of its own."""
    for many, few in FEW.items():
        text = text.replace(many, few)
    (folder / "train.py").write_text(text)
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "train.py", *words], cwd=folder, env=environment, capture_output=True,
        text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert not done.stderr, done.stderr


@pytest.mark.slow
def test_what_a_script_exports_is_what_its_model_learnt_from(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.chdir(tmp_path)
    run_script(SCRIPT, tmp_path)
    assert main([*WEIGH.split(), *QUICK, "--seeds", "0", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["rows"] == 150
    assert {row["learner"] for row in report["results"]} == {"tom", "pmac", "mle"}


def ended(folder: Path, name: str) -> Run:
    """The run, when its live weighings, one of TOM among them, have begun and ended."""
    run, ends = RunReader(folder / "runs" / name), ("finished", "failed", "stopped")

    def weighed() -> bool:
        return "tom" in run.live() and all(o.status.state in ends for o in run.live().values())

    wait_for(weighed, PATIENCE_S)
    found = loaded(folder / "runs", name)
    assert {str(one.summary["state"]) for one in (found, *found.live.values())} == {"finished"}
    return found


@pytest.mark.parametrize(
    ("script", "name"),
    [(SCRIPTS[0], "my-sac"), pytest.param(SCRIPTS[1], "weighted-sac", marks=pytest.mark.slow)],
)
def test_the_trainings_of_the_page(script: str, name: str, tmp_path: Path):
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
