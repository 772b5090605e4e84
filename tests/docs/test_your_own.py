"""docs/your-own.md: its lines are run, and what they export is what the model learnt from."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tom.cli import main

PAGE = (Path(__file__).parents[2] / "docs/your-own.md").read_text()
SCRIPT = re.search(r"`train.py`:\n\n```python\n(.*?)```", PAGE, re.DOTALL)
(WEIGH,) = re.findall(r"^tom (weigh .*)$", PAGE, re.MULTILINE)
QUICK = [
    "--preset", "paper", "--tom.q-hidden", "16", "--tom.q-steps", "20", "--seeds", "0", "--json",
    "--tom.discriminator-hidden", "16", "--tom.discriminator-steps", "20", "--footprint", "100",
]  # fmt: skip
STEPS = "learning_starts=500", "learn(4000)"
FEW = "learning_starts=100", "learn(150)"


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The page's script, in the folder that commands are called in."""
    assert SCRIPT, "the page has no train.py"
    (tmp_path / "train.py").write_text(SCRIPT[1])
    monkeypatch.chdir(tmp_path)
    return tmp_path


def train(folder: Path) -> None:
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, "train.py"], cwd=folder, env=environment, capture_output=True, text=True,
        check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr


@pytest.mark.slow
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
