"""The examples of docs/extend.md, applied to a copy of the code and run."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
STEP = re.compile(
    r"(?:New file `(?P<new>[^`]+)`|In `(?P<old>[^`]+)`, below `(?P<line>[^`]+)`):\n\n"
    r"```python\n(?P<code>.*?)```",
    re.DOTALL,
)
TRAIN = "-m tom train --env swimmer --preset smoke --steps 250 --no-rerun"
LEARNERS = {"example": "--learner reward", "other": "--learner surprise --surprise.steps 50"}
PAGE = """
from streamlit.testing.v1 import AppTest
from app.links import Links
import os, sys
os.environ |= Links(store=sys.argv[1]).environment()
app = AppTest.from_string("from app.views import pace\\npace.page()", default_timeout=60).run()
assert not app.exception, app.exception[0].message
assert sorted(app.dataframe[0].value["run"]) == ["example", "other"]
from app.router import VIEWS
assert VIEWS[-1].PATH == "pace"
from tom.record import RunReader
profiles = RunReader(sys.argv[1] + "/example").profiles()
assert 0 < profiles.ess[-1] < 0.999
from app.data import readers
from app.figures.surprise import reward_error
from app.parts import widgets
run = {run.run_id: run for run in readers.listing(sys.argv[1]).runs}["other"]
assert widgets.differs(run)
curve = widgets.curve(run, "surprise/error")
assert list(reward_error([curve], 300).data[0].y) == list(curve.value) and curve.value[-1] > 0
from tom.metrics import METRICS
assert "surprise/error" in METRICS
from app.parts.form import sections
shown = {name: sections("swimmer", name, "paper") for name in ("surprise", "reward", "tom")}
assert [name for name, groups in shown.items() if "surprise" in groups] == ["surprise"]
from tom.studies.returns import PAPER_ENVS
assert len(PAPER_ENVS) == 5 and "swimmer" not in PAPER_ENVS
"""


def apply(match: re.Match[str], root: Path) -> None:
    """Write the new file, or put the lines below the first one that begins as it is said."""
    if match["new"]:
        (root / match["new"]).write_text(match["code"])
        return
    path = root / match["old"]
    lines = path.read_text().splitlines(keepends=True)
    places = [i for i, text in enumerate(lines) if text.startswith(match["line"])]
    assert places, f"{match['old']} has no line {match['line']}"
    lines.insert(places[0] + 1, match["code"])
    path.write_text("".join(lines))


def python(words: list[str], root: Path) -> None:
    environment = {**os.environ, "PYTHONPATH": str(root), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, *words],
        cwd=root,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr


@pytest.fixture
def extended(tmp_path: Path) -> Path:
    """The code with every example of the page in it."""
    for package in ("tom", "app"):
        shutil.copytree(ROOT / package, tmp_path / package)
    steps = list(STEP.finditer((ROOT / "docs/extend.md").read_text()))
    assert len(steps) == 16
    for step in steps:
        apply(step, tmp_path)
    return tmp_path


def test_what_is_added_as_the_page_says_works(extended: Path):
    store = str(extended / "store")
    for name, learner in LEARNERS.items():
        words = f"{TRAIN} {learner} --run-id {name}".split()
        python([*words, "--store", store], extended)
    python(["-c", PAGE, store], extended)
